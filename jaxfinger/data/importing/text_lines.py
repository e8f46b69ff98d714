"""Lines of a text file, in any encoding, with a stamp or labels that a serial monitor writes into them as cells."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jaxfinger.data.importing.dates import seconds
from jaxfinger.data.importing.dialect import SHEET_ERRORS
from jaxfinger.errors import UserError

_FEW = 60  # lines, which show how a file is written
_MIN_SHARE = 0.8  # of them
_MANY = 3  # lines of another kind: fewer may be cut or mixed up
_STAMP = "time"  # name of the column of stamps beside labelled numbers
_STAMPED = re.compile(r"\s*(?:\[([^\]]+)\]\s*(?:->)?|(\S+(?: \S+)?)\s*->)\s*(\S.*)")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_LABELLED = re.compile(  # a label, a number and perhaps its unit
    rf"([A-Za-z_µ][^\s:=,;|\"'{{}}]*)\s*[:=]\s*"
    rf"((?:{_NUMBER.pattern}|nan|[+-]?inf)(?: ?[A-Za-zµ°%][A-Za-zµ°%/·]*)?)(?![^\s,;|])(?!\s*[:=])",
    re.IGNORECASE,
)
COMMENTS = ("#", "%")
MAX_QUOTED = 40  # characters of a line that a message quotes: enough to find it, and a terminal's half line
_LIST_IN_QUOTES = re.compile(r'"\[[^"\]]*\]"')  # pandas breaks the lines of a long array


@dataclass(frozen=True)
class Line:
    number: int  # line number in the file, from 1
    text: str


def read_lines(path: Path) -> list[Line]:
    """Lines of a file that are not blank, as rows of a table.

    A stamp that a serial monitor wrote before each line becomes the first cell, as that of `11:59:59.230 -> 1.5,20`.
    Where lines label their numbers, as `angle: 1.5, force: 20` or `angle=1.5 force=20`, the labels become names.

    Raises:
        UserError: many lines have other labels than most.
    """
    texts = enumerate(_lines(_decode(path.read_bytes())), 1)
    lines = [Line(number, text) for number, text in texts if text.strip()]
    usual = _usual(lines)
    if sum(_stamped(text) is not None for text in usual) > _MIN_SHARE * len(usual):
        mark = next((mark for mark in ";\t," if mark in usual[0]), " ")
        pairs = [(line, _stamped(line.text)) for line in lines]
        lines = [replace(line, text=line.text if pair is None else mark.join(pair)) for line, pair in pairs]
        usual = _usual(lines)
    labels = Counter(tuple(_labelled(text)) for text in usual)
    if not usual or len(usual) - labels.pop((), 0) <= _MIN_SHARE * len(usual):
        return lines
    names, count = labels.most_common(1)[0]
    others = [line for line in lines if not set(_labelled(line.text)) <= set(names)]
    refuse_others(path, f"labelled {', '.join(names)}", others)
    if count <= _MIN_SHARE * len(usual):
        return lines
    rows = [Line(0, "\t".join(names))]
    for line in lines:
        found = _labelled(line.text)
        rows.append(replace(line, text="\t".join(found.values())) if tuple(found) == names else line)
    return rows


def refuse_others(path: Path, usual: str, others: Sequence[Line]) -> None:
    """Refuse a file with many lines of another kind than the `usual` ones, as of another device.

    Raises:
        UserError: they are too many to be faults of single lines.
    """
    if len(others) >= _MANY:
        raise UserError(
            f"{path}: line {others[0].number} ({others[0].text.strip()[:MAX_QUOTED]!r}) and {len(others) - 1} more are "
            f"of another kind than the lines {usual}, as where two devices write into one file; give the lines of each "
            "device a file of its own (a column of a mapping may name its `file` and `time`), or correct them if they "
            "are damaged"
        )


def _usual(lines: Sequence[Line]) -> list[str]:
    """Some lines from the middle, after any header."""
    return [line.text for line in lines[len(lines) // 2 :][:_FEW]]


def _stamped(text: str) -> tuple[str, str] | None:
    """Stamp before an arrow or in brackets, and the rest of a line; None where there is none."""
    at = _STAMPED.fullmatch(text)
    stamp = (at[1] or at[2]).strip() if at else ""
    return (stamp, at[3]) if at and (seconds(stamp) is not None or _NUMBER.fullmatch(stamp)) else None


def _labelled(text: str) -> dict[str, str]:
    """Numbers of a line by their labels, a stamp before them by `time`; empty where the line holds anything else."""
    found = list(_LABELLED.finditer(text))
    before, *between = (part.strip(" \t,;|") for part in _LABELLED.sub("\0", text).split("\0"))
    stamp = seconds(before) is not None or _NUMBER.fullmatch(before)
    cells = ([(_STAMP, before)] if before else []) + [(at[1], at[2]) for at in found]
    named = dict(cells)
    return {} if not found or any(between) or (before and not stamp) or len(named) < len(cells) else named


def is_comment(text: str) -> bool:
    text = text.lstrip().lower()
    return text.startswith(COMMENTS) and not text.startswith(SHEET_ERRORS)


def _lines(text: str) -> list[str]:
    text = _LIST_IN_QUOTES.sub(lambda found: " ".join(found.group().split()), text)
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _decode(raw: bytes) -> str:
    """Decode by the byte order mark, as UTF-16 where many bytes are zero, as UTF-8, or else as Western European."""
    marks = (codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")
    for mark, encoding in marks:
        if raw.startswith(mark):
            return raw.decode(encoding, errors="replace")
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if raw[first:200:2].count(0) > 20:  # Latin text in UTF-16 has a zero in every second byte.
            return raw.decode(encoding, errors="replace")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")
