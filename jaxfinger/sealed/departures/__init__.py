"""The departures from the nominal model, in forms of the textbook; none of this code is the diagnosis's."""

from .draw import LISTED, UNLISTED, draw

__all__ = ["LISTED", "UNLISTED", "draw"]
