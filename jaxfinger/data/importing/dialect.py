"""Dialect of a table in text: separator and decimal mark, in which most cells are numbers; and numbers in cells.

Excel, TwinCAT Scope, oscilloscopes and `numpy.savetxt` differ in separator, decimal mark, quotes and header. The
standard library's Sniffer and its successors guess separator and quotes from punctuation, and know neither decimal
commas nor headers of several lines. Counting numbers finds all of these at once.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxfinger.data.importing.dates import seconds
from jaxfinger.data.units import is_foreign, unit_name

_BOOLEANS = {"true": 1.0, "false": 0.0}
# What programs and people write for a missing value: marks without letters and digits, words, errors of spreadsheets,
# and NaN of Microsoft's C library.
SHEET_ERRORS = ("#n/a", "#div/0!", "#value!", "#num!", "#null!", "#ref!", "#name?", "#nv", "#wert!", "#zahl!")
_MARK = re.compile(r"[-\u2010-\u2015*?.]+")
_MISSING = {
    *("na", "n/a", "n.a.", "n. a.", "nc", "n/c", "n.c.", "nd", "n/d", "n.d."),
    *("null", "nil", "none", "missing", "no data", "no value", "no signal", "not available", "not connected"),
    *SHEET_ERRORS,
    *("1.#qnan", "-1.#ind", "1.#ind", "-nan(ind)", "1.#inf", "-1.#inf"),
}
_FORTRAN = re.compile(r"([+-]?(?:\d+\.\d*|\.\d+))[dD]([+-]?\d+)$")  # a number of double precision
_QUANTITY = re.compile(r"[+-]?\d[\d.,]*(?:[eE][+-]?\d+)?\s*([A-Za-zµ°%][A-Za-z °·*/]*)")
_BLANKS = " \u00a0\u202f'’"  # that group digits, and are never a decimal mark
# Numbers with groups of three digits, by decimal mark. One group alone behind the other mark is no such number: 1,234
# may be 1234 or 1.234.
_GROUPED = {
    mark: re.compile(
        rf"^[+-]?\d{{1,3}}(?:(?:[{other}]\d{{3}})+[{mark}]\d*|(?:[{other}]\d{{3}}){{2,}}|"
        rf"(?:[{_BLANKS}]\d{{3}})+(?:[{mark}]\d*)?)$"
    )
    for mark, other in (".,", ",.")
}
ONE_GROUP = re.compile(r"^[+-]?[1-9]\d{0,2}[.,]\d{3}$")


@dataclass(frozen=True)
class Dialect:
    """Separator of the cells (None is any run of blanks) and decimal mark."""

    separator: str | None
    mark: str

    def split(self, line: str) -> list[str]:
        """Cells of a line."""
        if self.separator is None:
            return line.split()
        try:
            cells = next(csv.reader([line], delimiter=self.separator, skipinitialspace=True), [])
        except csv.Error:  # a cell of more than 128 KiB, which no table has
            cells = [line]
        return [cell.strip() for cell in cells]

    def number(self, cell: str, month_first: bool | None = None) -> float | None:
        """Number in a cell, s of a date or time of day: NaN where it is missing, None where there is something else."""
        cell = cell.replace("\u2212", "-")  # a minus sign as typesetters write it
        stamp = seconds(cell, month_first)
        if stamp is not None:
            return stamp
        unit = self.unit(cell)
        cell = cell.removesuffix(unit).rstrip() if unit else cell
        comma = self.mark == "," and cell.count(",") == 1 and "." not in cell
        value = _cell(cell.replace(",", ".") if comma else cell)
        if value is None and _GROUPED[self.mark].match(cell):
            other = "." if self.mark == "," else ","
            return float(re.sub(f"[{other}{_BLANKS}]", "", cell).replace(",", "."))
        return value

    def unit(self, cell: str) -> str:
        """Unit behind the number in a cell, as `ms` of `10 ms`; empty where there is none."""
        at = _QUANTITY.fullmatch(cell)
        return at[1] if at and (unit_name(at[1]) or is_foreign(at[1])) else ""


# Of equally good dialects the first is taken.
_DIALECTS = tuple(
    Dialect(*pair)
    for pair in (
        *((",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", "."), (None, "."), (None, ",")),
        (",", ","),  # with quotes around the numbers
    )
)


def find_dialect(sample: Sequence[str]) -> tuple[Dialect, list[bool]]:
    """Dialect of a file by some of its lines, and a mask of the columns that hold numbers."""
    best: tuple[tuple[float, int], Dialect, list[bool]] | None = None
    for dialect in _DIALECTS:
        rows = [dialect.split(line) for line in sample]
        widths = [len(row) for row in rows]
        width = max(set(widths), key=widths.count)
        rows = [row for row in rows if len(row) == width]
        if dialect.separator == dialect.mark and has_points(rows):
            continue  # A quoted cell such as "1,2" is then a list of two.
        numbers = np.array([[dialect.number(cell) is not None for cell in row] for row in rows])
        filled = np.array([[bool(cell) for cell in row] for row in rows])
        numeric = ((numbers & filled).sum(axis=0) * 2 > filled.sum(axis=0)) | ~filled.any(axis=0)
        share = float((numbers & filled).sum()) / max(int(filled.sum()), 1) * len(rows) / len(sample)
        score = (round(share, 2), width)  # Among dialects with about the same share of numbers, more columns win.
        if best is None or score > best[0]:
            best = score, dialect, numeric.tolist()
    assert best is not None
    return best[1], best[2] if best[0][0] > 0.0 else [False]


def has_points(rows: Sequence[Sequence[str]]) -> bool:
    """Whether a cell is a number with a decimal point."""
    return any(
        "." in cell and ":" not in cell and seconds(cell) is None and _cell(cell) is not None
        for row in rows
        for cell in row
    )


def _cell(cell: str) -> float | None:
    """Number with a decimal point, or truth: NaN where it is missing, None where the cell holds something else."""
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        pass
    if at := _FORTRAN.match(cell):
        return float(f"{at[1]}e{at[2]}")
    if cell.lower() in _BOOLEANS:
        return _BOOLEANS[cell.lower()]
    return np.nan if not cell or is_missing(cell) else None


def is_missing(cell: str) -> bool:
    """Whether a cell says that its value is missing, as `-`, `---`, `n/c` and `#N/A` do."""
    return cell.lower() in _MISSING or _MARK.fullmatch(cell) is not None
