"""Which joints, tendons, axes or sensors the columns of a channel belong to, by the names of both."""

from __future__ import annotations

import re
from collections.abc import Sequence

from jaxfinger.data.importing.names import as_word, words
from jaxfinger.data.importing.survey import ColumnSurvey
from jaxfinger.data.session import FingerDescription

_MIN_PART = 2  # letters of a name that counts as a part of a word: one letter is in many words


def known_names(channel: str, finger: FingerDescription | None) -> list[str]:
    """Names of the finger's joints or tendons that the columns of a channel may be of; empty where there are none."""
    if finger is None or channel in ("temperature", "fingertip_force"):
        return []
    return list(finger.joint_names if channel in ("q", "joint_torque") else finger.tendon_names)


def named_columns(columns: Sequence[ColumnSurvey], known: Sequence[str]) -> list[ColumnSurvey]:
    """Those columns that hold one of the `known` names, if each name is held; else all of them.

    A log of a whole robot has columns of joints that are not the finger's.
    """
    held = held_names(columns, known)
    all_held = known and set(held) >= set(known)
    return [s for s, name in zip(columns, held, strict=True) if name] if all_held else list(columns)


def assigned(
    channel: str, columns: Sequence[ColumnSurvey], finger: FingerDescription | None
) -> tuple[list[str], list[ColumnSurvey]]:
    """Names for the columns of a channel, and the columns that have one.

    A column has the name that it holds, and the others have those that are left, by number or in their order.
    """
    if channel == "temperature":
        return [s.name for s in columns], list(columns)
    if channel == "fingertip_force":
        return ["x", "y", "z"][: len(columns)], list(columns[:3])
    if finger is None:
        letter = "J" if channel in ("q", "joint_torque") else "T"
        named = [s.column if isinstance(s.column, str) else f"{letter}{k}" for k, s in enumerate(columns, 1)]
        return named, list(columns)
    known = known_names(channel, finger)
    held = held_names(columns, known)
    own = [name for name in held if name]
    if not own or len(set(own)) < len(own):
        pairs = list(zip(_by_number(columns, known), columns, strict=False))
    else:
        left = iter([name for name in known if name not in own])
        pairs = [(name or next(left, ""), s) for name, s in zip(held, columns, strict=True)]
    return [name for name, _ in pairs if name], [s for name, s in pairs if name]


def held_names(columns: Sequence[ColumnSurvey], known: Sequence[str]) -> list[str]:
    """The longest of the `known` names that each column's name holds, first as words of it; empty where it holds none.

    A joint with number 1 is no part of one with number 12.
    """
    held = []
    for s in columns:
        text = f"{s.name} {s.column or ''}"
        whole = [name for name in known if as_word(words(name)).search(words(text))]
        parts = [name for name in known if len(name) >= _MIN_PART and _part(name.lower()).search(text.lower())]
        held.append(max(whole or parts, key=len, default=""))
    return held


def _part(name: str) -> re.Pattern[str]:
    """Pattern of a name that may be a part of a word, while digits at its ends are whole numbers."""
    before, after = r"(?<!\d)" if name[0].isdigit() else "", r"(?!\d)" if name[-1].isdigit() else ""
    return re.compile(before + re.escape(name) + after)


def _by_number(columns: Sequence[ColumnSurvey], known: Sequence[str]) -> list[str]:
    """Names for columns that differ in a number alone, such as q2 and q1, by that number; else in their order."""
    parts = [re.split(r"(\d+)", s.name if s.column is None else f"{s.name} {s.column}") for s in columns]
    places = [k for k in range(len(parts[0])) if len({tuple(part[k : k + 1]) for part in parts}) > 1]
    if len({len(part) for part in parts}) > 1 or len(places) != 1 or places[0] % 2 == 0:
        return list(known)
    numbers = [int(part[places[0]]) for part in parts]
    if min(numbers) > 0 and max(numbers) <= len(known):
        return [known[number - 1] for number in numbers]
    return [known[sorted(numbers).index(number)] for number in numbers] if len(numbers) <= len(known) else list(known)
