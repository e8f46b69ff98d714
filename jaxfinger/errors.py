"""Errors that users can mend: one sentence, printed without a traceback."""

from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches

# What gives an argument of the public functions, by the name of its type or by its own.
GIVEN_BY = {
    "Session": "jf.read reads one",
    "Fit": "jf.identify makes one, and jf.load reads one",
    "Recipe": "jf.recipe reads one",
    "Diagnosis": "jf.diagnose makes one",
    "predictions": "jf.predict makes one, and jf.read_predictions reads one",
    "tolerance": "such as {'joint_torque': 0.02}",
    "effects": "classes by their IDs, or the name of a Python file",
}


class UserError(Exception):
    """Mistake in a file, a recipe or a command; the message names the place and the remedy."""


def require(kind: type | tuple[type | None, ...], **given: object) -> None:
    """Refuse arguments of a public function that are of another type; None in `kind` allows None.

    Raises:
        UserError: the first such argument, by its name, with what to give.
    """
    kinds = tuple(type(None) if k is None else k for k in (kind if isinstance(kind, tuple) else (kind,)))
    for name, value in given.items():
        if not isinstance(value, kinds):
            wanted = [k.__name__ for k in kinds if k is not type(None)]
            how = GIVEN_BY.get(wanted[0]) or GIVEN_BY.get(name, "")
            raise UserError(
                f"{name} is of type {type(value).__name__}; give a {' or '.join(wanted)}{how and f' ({how})'}"
            )


def chosen(said: str | Iterable[str], known: Collection[str], what: str) -> tuple[str, ...]:
    """The names said, one or several, each a `what` among those `known`.

    Raises:
        UserError: one of them is not known.
    """
    names = (said,) if isinstance(said, str) else tuple(said)
    for name in names:
        if name not in known:
            raise UserError(f"there is no {what} {name!r}{did_you_mean(name, known)}; there are {listed([*known], 12)}")
    return names


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
