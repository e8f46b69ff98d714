"""Sentences, `gap.json`, figures and pages from fits and diagnoses."""
