"""Import of other tools' recordings as sessions, by a mapping file."""
