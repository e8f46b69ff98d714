"""What a user can mend is said in one sentence, without a traceback."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(Exception):
    """A mistake in a file, a recipe or a command: the message names the place and the mend."""


def did_you_mean(said: object, known: Iterable[str]) -> str:
    """` (did you mean 'time'?)`, to follow a name that is not known; empty where none is near it."""
    close = get_close_matches(said, list(known), 1) if isinstance(said, str) else []
    return f" (did you mean {close[0]!r}?)" if close else ""
