"""CSV files and other tables in text, of any program."""

from __future__ import annotations

import codecs
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxfinger.data.importing.dates import is_packed_date, month_first, packed_texts, seconds
from jaxfinger.data.importing.dialect import MISSING, ONE_GROUP, SHEET_ERRORS, Dialect, find_dialect, has_points
from jaxfinger.data.importing.joint_states import JointStates, joint_states
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.units import stated_units
from jaxfinger.errors import UserError, counted, listed

_COMMENTS = ("#", "%")
_DIALECT_LINES = 60  # They decide the dialect, and are taken from the middle of the file, after any header.
_MIN_NUMBERED = 3  # columns, from which on a first line of 0, 1, 2 … numbers them
_UNIT = r"%|°|deg|rad|turn|rev|rpm|k?Hz|[mun]?s|[munc]?m|[mk]?N|[mk]?N[ ·*]?[cm]?m|[mu]?A|[mk]?V|°?C|K|[mk]?g|1|-|bool"
_UNIT_CELL = re.compile(rf"^[\[(]?({_UNIT}|{_UNIT}/s2?|)[\])]?$")
_LIST = re.compile(r"^(\[.*\]|\(.*\))$", re.DOTALL)
_LIST_IN_QUOTES = re.compile(r'"\[[^"\]]*\]"')  # pandas breaks the lines of a long array
_HOUR = re.compile(r"\d:\d\d")  # in a time of day or a date
# What OpenSim's tables of motion say in their header, of the angles among their columns, and the unit that it means.
_IN_DEGREES = re.compile(r"^\s*inDegrees\s*=\s*(yes|no)\s*$", re.IGNORECASE | re.MULTILINE)
_ANGLES = {"yes": "deg", "no": "rad"}
_LOST = "A message was lost!!!", "\ttotal count"  # how lines begin that `ros2 topic echo` writes between messages
_SCOPE = "SampleTime[ms]"  # header of TwinCAT Scope, which writes a column of times in ms beside each channel


@dataclass(frozen=True)
class _Line:
    number: int  # line number in the file, from 1
    text: str


def load_csv(path: Path) -> Recording:
    """Load the columns of a CSV file by the names above the numbers, or as `column 0`, `column 1` and so on.

    Empty cells and words for a missing value (`-`, `#N/A`) are NaN, True and False are 1 and 0, dates with a time of
    day are seconds since 1970, and times of day seconds since midnight. A column of lists in brackets, one a sample, is
    an array. A column of words can be tested, not computed with. Messages of a JointState that `ros2 topic echo --csv`
    wrote have the names of its fields.

    Raises:
        UserError: the file has no column of numbers, or a line with another number of cells.
    """
    lines = [_Line(number, text) for number, text in enumerate(_lines(_decode(path.read_bytes())), 1) if text.strip()]
    body = [line for line in lines if not _is_comment(line.text) and not line.text.startswith(_LOST)]
    if not body:
        raise UserError(f"{path}: holds no samples; it needs a line of names, then one line a sample")
    sample = body[len(body) // 2 :][:_DIALECT_LINES]
    dialect, numeric = find_dialect([line.text for line in sample])
    split = dialect.split
    if not any(numeric) and len(body) == 1:
        raise UserError(f"{path}: holds names and no samples; record it again, or leave it out")
    if not any(numeric):
        raise UserError(f"{path}: holds no column of numbers; give a table with one line a sample")
    first = next(i for i, line in enumerate(body) if _is_sample(dialect, split(line.text), numeric))
    above = [line for line in lines if line.number < body[first].number]
    rows = [row for line in sample if len(row := split(line.text)) == len(numeric)]
    names, units, scope = _names(above, dialect, len(numeric), blank=not any(row[-1] for row in rows))
    states = None if names else joint_states(rows, dialect.number)
    if not names and states is None and first > 0 and len(split(body[first - 1].text)) != len(numeric):
        given = counted(len(split(body[first - 1].text)), "column")
        raise UserError(f"{path}: names {given} and holds {len(numeric)}; give each column one name")
    lost = sum(line.text.startswith(_LOST[0]) for line in lines)
    remarks = (f"says {counted(lost, 'time')} that messages were lost",) if lost else ()
    body = body[first:]
    if not names and _numbers_columns(dialect, body):
        names, body = tuple(split(body[0].text)), body[1:]
    if len(body) > 1 and len(split(body[-1].text)) < len(numeric):
        body, remarks = body[:-1], (*remarks, "its last line is cut short and is left out")
    if skipped := [line.number for line in above if _holds_numbers(dialect, split(line.text), numeric)]:
        remarks = (*remarks, f"has numbers in line {skipped[0]} above its first whole sample, which are left out")
    columns = _columns(path, body, dialect, numeric)
    if states is not None:
        return _of_states(path, columns, states, remarks)
    if scope:
        return _pairs(path, columns, names, units)
    degrees = _IN_DEGREES.search("\n".join(line.text for line in above))
    angles = _ANGLES[degrees[1].lower()] if degrees else ""
    return replace(_named(path, columns, names, units, remarks), angles=angles)


def _numbers_columns(dialect: Dialect, body: Sequence[_Line]) -> bool:
    """Whether the first line numbers the columns, 0, 1, 2 and so on, as pandas writes it over columns without names.

    With one column or two such a line is a sample: a clock begins with 0, and 1 may stand beside it.
    """
    first = [dialect.number(cell) for cell in dialect.split(body[0].text)]
    return len(body) > 1 and len(first) >= _MIN_NUMBERED and first == list(range(len(first)))


def _is_comment(text: str) -> bool:
    text = text.lstrip().lower()
    return text.startswith(_COMMENTS) and not text.startswith(SHEET_ERRORS)


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


def _numbers(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> list[float | None]:
    """Numbers of a line in the columns of numbers, as far as it reaches."""
    return [dialect.number(cell) for cell, number in zip(cells, numeric, strict=False) if number]


def _is_sample(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> bool:
    values = _numbers(dialect, cells, numeric)
    return len(cells) == len(numeric) and None not in values and not all(np.isnan(v) for v in values if v is not None)


def _holds_numbers(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> bool:
    """Whether most of a line's cells are numbers where a sample has numbers."""
    values = _numbers(dialect, cells, numeric)
    count = sum(value is not None and not np.isnan(value) for value in values)
    return len(cells) == len(numeric) and 2 * count > len(values)


def _names(
    above: Sequence[_Line], dialect: Dialect, width: int, blank: bool
) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Names of the columns, their units, and whether they are pairs of time and value as TwinCAT Scope writes them.

    The names are the nearest line above the numbers that has a cell for each column and holds no units. They may stand
    behind a comment mark (numpy.savetxt, gnuplot). Either they or the numbers may end with a separator, after which the
    last column is `blank`.
    """
    rows = []
    for line in reversed(above):
        text = line.text.strip()
        plain = text.lstrip("".join(_COMMENTS)).strip()
        cells = dialect.split(line.text if plain == text else plain)
        if plain != text and len(cells) != width:
            cells = plain.replace(",", " ").split()
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if blank and len(cells) == width - 1:
            cells.append("")
        if len(cells) == width and any(cells):
            rows.append(cells)
    labelled = {row[0]: tuple(row) for row in rows if row[::2] == row[:1] * (width // 2) and width % 2 == 0}
    if _SCOPE in labelled and "Name" in labelled:
        return labelled["Name"], labelled.get("Unit", ("",) * width), True
    words = [row for row in rows if sum(_is_word(dialect, cell) for cell in row) * 2 > width]
    units = ("",) * width
    if len(words) > 1 and all(_UNIT_CELL.match(cell) for cell in words[0]):
        units = tuple(cell.strip("[]()") for cell in words.pop(0))
    return tuple(words[0]) if words else (), units, False


def _is_word(dialect: Dialect, cell: str) -> bool:
    """Whether a cell above the numbers is a name or a unit; `-` is the unit of a ratio."""
    return dialect.number(cell) is None or cell.lower() in MISSING


@dataclass(frozen=True)
class _Column:
    """A column as numbers; without them the reason, and the words where it holds words."""

    values: np.ndarray | None
    fault: str = ""
    words: np.ndarray | None = None
    units: str = ""  # of dates and times of day, whatever the header says
    remark: str = ""  # the end of a sentence that begins with the column's name


def _columns(path: Path, body: Sequence[_Line], dialect: Dialect, numeric: Sequence[bool]) -> list[_Column]:
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
                return [_Column(x) for x in table]
        except ValueError:
            pass
    rows = []
    for line in body:
        rows.append(dialect.split(line.text) if quoted else line.text.split(separator))
        if len(rows[-1]) != width:
            raise UserError(
                f"{path}: line {line.number} has {len(rows[-1])} cells, the others have {width}; correct or drop it"
            )
    # Where both marks stand for decimals in one file, or seem to, a number such as 1,234 is not clear.
    mixed = dialect.mark == "," and has_points(rows)
    if separator == dialect.mark == ",":  # Quoted cells such as "1,234" may also hold groups of digits.
        mixed |= all(ONE_GROUP.match(cell.strip()) for row in rows for cell in row if "," in cell)
    at = [line.number for line in body]
    return [_column(cells, at, dialect, numeric[k], mixed) for k, cells in enumerate(zip(*rows, strict=True))]


def _column(cells: Sequence[str], lines: Sequence[int], dialect: Dialect, numeric: bool, mixed: bool) -> _Column:
    """A column from its cells and their line numbers. With `mixed`, a number with one group of digits is not clear."""
    cells = [cell.strip() for cell in cells]
    if (stamps := packed_texts(cells)) is not None:
        return _Column(stamps, units="s")
    if numeric and not mixed and (values := _plain_numbers(cells, dialect.mark)) is not None:
        return _Column(values)
    months, either = month_first(set(cells))
    known = {cell: None if mixed and ONE_GROUP.match(cell) else dialect.number(cell, months) for cell in set(cells)}
    values = [known[cell] for cell in cells]
    bad = [k for k, value in enumerate(values) if value is None]
    if not bad:
        timed = any(seconds(cell) is not None for cell in known)
        read = f"has dates such as {either}, read with the {'month' if months else 'day'} first" if either else ""
        return _Column(np.array(values, np.float64), units="s" if timed else "", remark=read)
    first = cells[bad[0]]
    if all(_LIST.match(cell) for cell in cells if cell):
        return _lists(cells)
    some_numbers = any(value is not None and not np.isnan(value) for value in known.values())
    if some_numbers or _HOUR.search(first) or ONE_GROUP.match(first):
        return _Column(None, _fault(first, lines[bad[0]], len(bad) - 1))
    there = listed([repr(cell) for cell in dict.fromkeys(cells) if cell], 4)
    fault = f"holds the words {there}; a trial's `where` can test it"
    return _Column(None, fault, np.array(cells, np.dtypes.StringDType()))


def _lists(cells: Sequence[str]) -> _Column:
    """A column of lists such as `[0.1, 0.2]` or `(0.1, 0.2)`, one a sample, as arrays; an empty cell is one of NaN."""
    try:
        rows = [np.array(cell[1:-1].replace(",", " ").split(), np.float64) for cell in cells]
    except ValueError:
        return _Column(None, "holds lists of words; give lists of numbers")
    widths = {len(row) for row, cell in zip(rows, cells, strict=True) if cell}
    if len(widths) != 1 or 0 in widths:
        return _Column(None, "holds lists of different lengths; give each sample as many numbers")
    missing = np.full(next(iter(widths)), np.nan)
    return _Column(np.array([row if cell else missing for row, cell in zip(rows, cells, strict=True)]))


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
    mend = "empty these cells where a value is missing, else write numbers" if others else "correct or drop that line"
    if _HOUR.search(cell):
        mend = "write seconds, or dates and times as 2026-01-31 12:00:00.000"
    return f"holds {cell!r} in line {line}, which is no number{more}; {mend}"


def _named(
    path: Path, columns: Sequence[_Column], names: Sequence[str], units: Sequence[str], remarks: tuple[str, ...]
) -> Recording:
    """Recording of a table with named columns. Columns that share a name or hold no numbers are unusable."""
    names = names or ("",) * len(columns)
    places: dict[str, list[int]] = defaultdict(list)
    for k, (name, column) in enumerate(zip(names, columns, strict=True)):
        if name or column.values is None or not np.isnan(column.values).all():  # Trailing separators make empty ones.
            places[name or f"column {k}"].append(k)
    variables, unusable, words = {}, {}, {}
    remarks += tuple(f"{name} {columns[k].remark}" for name, (k, *_) in places.items() if columns[k].remark)
    for name, (k, *others) in places.items():
        column = columns[k]
        if others:
            numbers = " and ".join(str(place + 1) for place in (k, *others))
            unusable[name] = f"is the name of the columns {numbers}; give each column its own name"
        elif column.values is not None:
            variables[name] = Variable(column.values, units=column.units or units[k] or stated_units(name))
        else:
            unusable[name] = column.fault
            if column.words is not None:
                words[name] = column.words
    return Recording(path, variables, unusable, remarks, words)


def _of_states(path: Path, columns: Sequence[_Column], states: JointStates, remarks: tuple[str, ...]) -> Recording:
    """Recording of the messages of a JointState.

    Raises:
        UserError: the names of the joints change, or a cell is no number.
    """
    where, no_numbers = f"{path}: is of `ros2 topic echo --csv`, and", np.zeros(0)
    for column in columns:
        if column.words is not None and len(set(column.words)) > 1:
            said = column.fault.split(";")[0]
            raise UserError(f"{where} a place {said}; echo the topic of one publisher alone, or record a bag")
        if column.values is None and column.words is None:
            raise UserError(f"{where} a column {column.fault}")
    values = [no_numbers if column.values is None else column.values for column in columns]
    return Recording(path, states.variables(values), remarks=remarks)


def _pairs(path: Path, columns: Sequence[_Column], names: Sequence[str], units: Sequence[str]) -> Recording:
    """Recording of TwinCAT Scope, with a column of times in ms before every channel. It becomes `name.time`, in s."""
    variables: dict[str, Variable] = {}
    unusable: dict[str, str] = {}
    for k in range(0, len(columns), 2):
        name, clock, channel = names[k + 1], columns[k], columns[k + 1]
        if name in variables or name in unusable:
            variables.pop(name, None)
            unusable[name] = "is the name of two channels; give each channel its own name"
        elif clock.values is None or channel.values is None:
            unusable[name] = clock.fault or channel.fault
        else:
            filled = np.isfinite(clock.values)  # Channels with a lower sampling rate end earlier.
            variables[f"{name}.time"] = Variable(clock.values[filled] * 1e-3, units="s")
            variables[name] = Variable(channel.values[filled], clock=f"{name}.time", units=units[k + 1])
    return Recording(path, variables, unusable)
