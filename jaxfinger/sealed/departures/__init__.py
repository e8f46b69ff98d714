"""The departures from the nominal model, in forms of the textbook; none of this code is the diagnosis's."""

from .draw import LISTED, UNLISTED, draw, draw_at, sites

__all__ = ["LISTED", "UNLISTED", "draw", "draw_at", "sites"]
