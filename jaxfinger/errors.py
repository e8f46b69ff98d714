"""Errors that users can mend: one sentence, printed without a traceback."""

from collections.abc import Collection, Sequence
from difflib import get_close_matches


class UserError(Exception):
    """Mistake in a file, a recipe or a command; the message names the place and the remedy."""


def did_you_mean(said: object, known: Collection[str]) -> str:
    """Suffix ` (did you mean 'time'?)` for a message on an unknown name; empty where no known name is similar."""
    if not isinstance(said, str):
        return ""
    # difflib counts swapped letters as two mistakes and letters of another case as wrong; these come first.
    swapped = [name for name in known if sorted(name.casefold()) == sorted(said.casefold())]
    close = swapped or get_close_matches(said, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def counted(number: int, noun: str) -> str:
    """Number and noun, as `1 error` or `2 errors`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names as part of a sentence: the first `most` ones, and how many more there are."""
    shown = ", ".join(names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown or "none"
