"""What a user can mend is said in one sentence, without a traceback."""

from collections.abc import Collection
from difflib import get_close_matches


class UserError(Exception):
    """A mistake in a file, a recipe or a command: the message names the place and the mend."""


def did_you_mean(said: object, known: Collection[str]) -> str:
    """` (did you mean 'time'?)`, to follow a name that is not known; empty where none is near it."""
    if not isinstance(said, str):
        return ""
    # Letters swapped, which difflib counts as two mistakes, or of another case, which it takes for others.
    swapped = [name for name in known if sorted(name.casefold()) == sorted(said.casefold())]
    close = swapped or get_close_matches(said, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def counted(number: int, noun: str) -> str:
    """`1 error`, `2 errors`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
