"""Departures of the plant from the nominal model, in textbook forms. They share no code with the diagnosis."""

from .draw import LISTED, UNLISTED, draw, draw_at, sites

__all__ = ["LISTED", "UNLISTED", "draw", "draw_at", "sites"]
