"""Columns of a table in text, from its rows: numbers, times, lists and words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfinger.data.importing.dates import is_packed_date, month_first, packed_texts, past_midnight, seconds
from jaxfinger.data.importing.dialect import ONE_GROUP, Dialect, has_points
from jaxfinger.data.importing.text_lines import Line, refuse_others
from jaxfinger.errors import UserError, counted, listed

_LIST = re.compile(r"^(\[.*\]|\(.*\))$", re.DOTALL)
_HEX = re.compile(r"(0[xX])?[0-9A-Fa-f]+")
_HOUR = re.compile(r"\d:\d\d")  # in a time of day or a date


@dataclass(frozen=True)
class Column:
    """A column as numbers; without them the reason, and the words where it holds words."""

    values: np.ndarray | None
    fault: str = ""
    words: np.ndarray | None = None
    units: str = ""  # that its cells state, s of dates and times of day, whatever the header says
    remark: str = ""  # the end of a sentence that begins with the column's name


def read_columns(path: Path, body: Sequence[Line], dialect: Dialect, numeric: Sequence[bool]) -> list[Column]:
    """Columns of a table; `numeric` tells those in which most cells are numbers."""
    separator, width, texts = dialect.separator, len(numeric), [line.text for line in body]
    quoted = separator is None or any('"' in text for text in texts)
    plain = all(numeric) and not quoted and not (dialect.mark == "," and any("." in text for text in texts))
    if plain and all(text.count(str(separator)) == width - 1 for text in texts):
        try:  # numpy reads plain numbers much faster than the loop below.
            if dialect.mark == ",":
                texts = [text.replace(",", ".") for text in texts]
            table = np.loadtxt(texts, delimiter=separator, ndmin=2, comments=None).T
            if not any(is_packed_date(float(x[0])) for x in table):
                return [Column(x) for x in table]
        except ValueError:
            pass
    rows = [dialect.split(line.text) if quoted else line.text.split(separator) for line in body]
    others = [line for line, row in zip(body, rows, strict=True) if len(row) != width]
    refuse_others(path, f"of {width} cells", others)
    if others:
        cells = len(dialect.split(others[0].text))
        raise UserError(
            f"{path}: line {others[0].number} has {cells} cells, the others have {width}; correct or drop it"
        )
    # Where both marks stand for decimals in one file, or seem to, a number such as 1,234 is not clear.
    mixed = dialect.mark == "," and has_points(rows)
    if separator == dialect.mark == ",":  # Quoted cells such as "1,234" may also hold groups of digits.
        mixed |= all(ONE_GROUP.match(cell.strip()) for row in rows for cell in row if "," in cell)
    at = [line.number for line in body]
    return [_column(cells, at, dialect, numeric[k], mixed) for k, cells in enumerate(zip(*rows, strict=True))]


def _column(cells: Sequence[str], lines: Sequence[int], dialect: Dialect, numeric: bool, mixed: bool) -> Column:
    """A column from its cells and their line numbers. With `mixed`, a number with one group of digits is not clear."""
    cells = [cell.strip() for cell in cells]
    if (stamps := packed_texts(cells)) is not None:
        return Column(stamps, units="s")
    if numeric and not mixed and (values := _plain_numbers(cells, dialect.mark)) is not None:
        return Column(values)
    months, either = month_first(set(cells))
    known = {cell: None if mixed and ONE_GROUP.match(cell) else dialect.number(cell, months) for cell in set(cells)}
    values = [known[cell] for cell in cells]
    bad = [k for k, value in enumerate(values) if value is None]
    if not bad:
        stated = {dialect.unit(cell) for cell in known if cell and not np.isnan(known[cell] or 0.0)}
        if len(stated) > 1:
            mixed_units = listed([repr(unit) if unit else "none" for unit in sorted(stated)])
            return Column(None, f"has cells with different units ({mixed_units}); write one unit throughout")
        if unit := "".join(stated):
            return Column(np.array(values, np.float64), units=unit)
        timed = any(seconds(cell) is not None for cell in known)
        read = f"has dates such as {either}, read with the {'month' if months else 'day'} first" if either else ""
        numbers = np.array(values, np.float64)
        return Column(past_midnight(numbers) if timed else numbers, units="s" if timed else "", remark=read)
    first = cells[bad[0]]
    if all(_LIST.match(cell) for cell in cells if cell):
        return _lists(cells)
    if _is_hexadecimal(cells):
        mend = "write them in decimal and with their sign; in Python int(x, 16) reads those without one"
        return Column(None, f"holds numbers in hexadecimal ({first!r} in line {lines[bad[0]]}); {mend}")
    some_numbers = any(value is not None and not np.isnan(value) for value in known.values())
    if some_numbers or _HOUR.search(first) or ONE_GROUP.match(first):
        return Column(None, _fault(first, lines[bad[0]], len(bad) - 1))
    there = listed([repr(cell) for cell in dict.fromkeys(cells) if cell], 4)
    fault = f"holds the words {there}; a trial's `where` can test it"
    return Column(None, fault, np.array(cells, np.dtypes.StringDType()))


def _is_hexadecimal(cells: Sequence[str]) -> bool:
    """Whether cells are hexadecimal: behind 0x, or as many digits each with those from 0 to 9 among them."""
    filled = [cell for cell in cells if cell]
    if not all(map(_HEX.fullmatch, filled)):
        return False
    marked = all(cell[:2] in ("0x", "0X") for cell in filled)
    return marked or (len({len(cell) for cell in filled}) == 1 and any(cell.isdecimal() for cell in filled))


def _lists(cells: Sequence[str]) -> Column:
    """A column of lists such as `[0.1, 0.2]` or `(0.1, 0.2)`, one a sample, as arrays; an empty cell is one of NaN."""
    try:
        rows = [np.array(cell[1:-1].replace(",", " ").split(), np.float64) for cell in cells]
    except ValueError:
        return Column(None, "holds lists of words; give lists of numbers")
    widths = {len(row) for row, cell in zip(rows, cells, strict=True) if cell}
    if len(widths) != 1 or 0 in widths:
        return Column(None, "holds lists of different lengths; give each sample as many numbers")
    missing = np.full(next(iter(widths)), np.nan)
    return Column(np.array([row if cell else missing for row, cell in zip(rows, cells, strict=True)]))


def _plain_numbers(cells: Sequence[str], mark: str) -> np.ndarray | None:
    """Numbers of a column without groups of digits, dates and words, which are read much faster; None for others."""
    text = "".join(cells)
    if "_" in text or (mark == "," and "." in text):
        return None
    points = cells if mark == "." else [cell.replace(mark, ".") for cell in cells]
    try:
        return np.array([cell or "nan" for cell in points], np.float64)
    except ValueError:
        return None


def _fault(cell: str, line: int, others: int) -> str:
    """Why a column cannot be used, by its first cell that is no number and the count of others."""
    more = f", and {counted(others, 'more cell')} of this kind" if others else ""
    if ONE_GROUP.match(cell):
        whole, part = re.split("[.,]", cell)
        read = f"which is {whole}.{part} or {whole}{part}"
        return f"holds {cell!r} in line {line}, {read}{more}; write it without thousands separators"
    mend = "drop these lines, or empty the cells where a value is missing" if others else "correct or drop that line"
    if _HOUR.search(cell):
        mend = "write seconds, or dates and times as 2026-01-31 12:00:00.000"
    return f"holds {cell!r} in line {line}, which is no number{more}; {mend}"
