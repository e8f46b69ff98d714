"""CSV files and other tables in text, of any program."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfinger.data.importing import labview
from jaxfinger.data.importing.dialect import Dialect, find_dialect, is_missing
from jaxfinger.data.importing.joint_states import JointStates, joint_states
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.importing.text_columns import Column, read_columns
from jaxfinger.data.importing.text_lines import COMMENTS, MAX_QUOTED, Line, is_comment, read_lines
from jaxfinger.data.units import is_foreign, is_ratio, stated_units, unit_name
from jaxfinger.errors import UserError, counted

_DIALECT_LINES = 60  # They decide the dialect, and are taken from the middle of the file, after any header.
_MIN_NUMBERED = 3  # columns, from which on a first line of 0, 1, 2 … numbers them
_UNIT = r"%|°|deg|rad|turn|rev|rpm|k?Hz|[mun]?s|[munc]?m|[mk]?N|[mk]?N[ ·*]?[cm]?m|[mu]?A|[mk]?V|°?C|K|[mk]?g|1|-|bool"
_UNIT_CELL = re.compile(rf"^[\[(]?({_UNIT}|{_UNIT}/s2?|)[\])]?$")
# What OpenSim's tables of motion say in their header, of the angles among their columns, and the unit that it means.
_IN_DEGREES = re.compile(r"^\s*inDegrees\s*=\s*(yes|no)\s*$", re.IGNORECASE | re.MULTILINE)
_ANGLES = {"yes": "deg", "no": "rad"}
_LOST = "A message was lost!!!", "\ttotal count"  # how lines begin that `ros2 topic echo` writes between messages
_NO_CHANNEL = "comment"  # the last name in a LabVIEW measurement file, of cells that only the first sample may have
# A frame of a CAN bus, with its bytes in hexadecimal, as `candump` and Vector's `.asc` write it.
_FRAME = re.compile(
    r"\s*(\([\d.]+\)\s+)?[a-z]+\d+\s+[0-9A-F]{3,8}(#|\s+\[\d+\])|\s*[\d.]+\s+\d+\s+[0-9A-F]+x?\s+[RT]x\s+d\s+\d",
    re.IGNORECASE,
)
_SCOPE = "SampleTime[ms]"  # header of TwinCAT Scope, which writes a column of times in ms beside each channel


def load_csv(path: Path) -> Recording:
    """Load the columns of a CSV file by the names above the numbers, or as `column 0`, `column 1` and so on.

    Empty cells and marks of a missing value (`-`, `---`, `n/c`, `#N/A`) are NaN, True and False are 1 and 0, dates with
    a time of day are seconds since 1970, and times of day seconds since midnight. A column of lists in brackets, one a
    sample, is an array. A column of words can be tested, not computed with. Messages of a JointState that `ros2 topic
    echo --csv` wrote have the names of its fields.

    Raises:
        UserError: the file has no column of numbers, or a line with another number of cells.
    """
    lines = read_lines(path)
    body = [line for line in lines if not is_comment(line.text) and not line.text.startswith(_LOST)]
    if not body:
        raise UserError(f"{path}: holds no samples; it needs a line of names, then one line a sample")
    if any(line.text.strip() == "---" for line in body) and any(line.text.strip() == "header:" for line in body):
        raise UserError(f"{path}: holds messages as `ros2 topic echo` prints them; echo with --csv, or record a bag")
    sample = body[len(body) // 2 :][:_DIALECT_LINES]
    if 2 * sum(_FRAME.match(line.text) is not None for line in sample) > len(sample):
        raise UserError(
            f"{path}: holds frames of a CAN bus, whose bytes are no quantities yet; decode them, in Python by "
            "`cantools` with the drives' .dbc file, or by the drives' manual, and write a CSV with one line a sample"
        )
    dialect, numeric = find_dialect([line.text for line in sample])
    split = dialect.split
    if not any(numeric) and len(body) == 1:
        raise UserError(f"{path}: holds names and no samples; record it again, or leave it out")
    if not any(numeric):
        raise UserError(f"{path}: holds no column of numbers; give a table with one line a sample")
    first = next(i for i, line in enumerate(body) if _is_sample(dialect, split(line.text), numeric))
    rows = [row for line in sample if len(row := split(line.text)) == len(numeric)]
    # A column that is blank in the middle of the file may hold words before, as names of trials do.
    shown = [number and _shows_numbers(dialect, cells) for number, *cells in zip(numeric, *rows, strict=True)]
    while first > 0 and any(shown) and _is_sample(dialect, split(body[first - 1].text), shown):
        first -= 1
    above = [line for line in lines if line.number < body[first].number]
    blank = not any(row[-1] for row in rows)
    heads = _heads(above, dialect, len(numeric), blank)
    names, units, scope = _names(heads, dialect, len(numeric))
    states = None if names else joint_states(rows, dialect.number)
    before = split(body[first - 1].text) if first > 0 else []
    # A recording may begin within a line, or after a message of the board.
    cut = all(dialect.number(cell) is not None for cell in before)
    message = len(before) == 1 and len(body) - first > 1 and len(re.split(r"[\s,;]+", before[0])) != len(numeric)
    if not names and states is None and not cut and not message and len(before) != len(numeric):
        given = counted(len(before), "column")
        raise UserError(f"{path}: names {given} and holds {len(numeric)}; give each column one name")
    lost = sum(line.text.startswith(_LOST[0]) for line in lines)
    remarks = (f"says {counted(lost, 'time')} that messages were lost",) if lost else ()
    body, said = _without_words(dialect, body[first:], len(numeric), names)
    if said:
        count = counted(len(said), "line")
        where = f"in line {said[0].number} ({said[0].text.strip()[:MAX_QUOTED]!r})"
        remarks = (*remarks, f"has {count} without numbers among its samples, the first {where}, left out")
    if not names and _numbers_columns(dialect, body):
        names, body = tuple(split(body[0].text)), body[1:]
    if len(body) > 1 and len(split(body[-1].text)) < len(numeric):
        body, remarks = body[:-1], (*remarks, "its last line is cut short and is left out")
    if skipped := [line.number for line in above if _holds_numbers(dialect, split(line.text), numeric)]:
        remarks = (*remarks, f"has numbers in line {skipped[0]} above its first whole sample, which are left out")
    columns = read_columns(path, body, dialect, numeric)
    if states is not None:
        return _of_states(path, columns, states, remarks)
    if scope:
        return _pairs(path, columns, names, units)
    degrees = _IN_DEGREES.search("\n".join(line.text for line in above))
    angles = _ANGLES[degrees[1].lower()] if degrees else ""
    recording = replace(_named(path, columns, names, units, remarks), angles=angles)
    return labview.timed(recording, heads, dialect.number) if labview.wrote(heads) else recording


def _without_words(
    dialect: Dialect, body: Sequence[Line], width: int, names: tuple[str, ...]
) -> tuple[list[Line], list[Line]]:
    """Lines of samples; and those between them that hold no number, as prompts and repeated names do."""
    separator = dialect.separator
    usual = lambda text: len(text.split()) if separator is None else text.count(separator) + 1  # noqa: E731
    kept, said = [], []
    for line in body:
        cells = dialect.split(line.text) if usual(line.text) != width or line.text.startswith(names[:1]) else None
        numbers = cells is None or any(
            dialect.number(cell) is not None for cell in cells if cell and not is_missing(cell)
        )
        of_words = cells is not None and not numbers and (len(cells) != width or tuple(cells) == names)
        (said if of_words else kept).append(line)
    return kept, said


def _numbers_columns(dialect: Dialect, body: Sequence[Line]) -> bool:
    """Whether the first line numbers the columns, 0, 1, 2 and so on, as pandas writes it over columns without names.

    With one column or two such a line is a sample: a clock begins with 0, and 1 may stand beside it.
    """
    first = [dialect.number(cell) for cell in dialect.split(body[0].text)]
    return len(body) > 1 and len(first) >= _MIN_NUMBERED and first == list(range(len(first)))


def _numbers(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> list[float | None]:
    """Numbers of a line in the columns of numbers, as far as it reaches."""
    return [dialect.number(cell) for cell, number in zip(cells, numeric, strict=False) if number]


def _shows_numbers(dialect: Dialect, cells: Sequence[str]) -> bool:
    """Whether some cell of a column is a number, not only blank or a mark of a missing one."""
    return any(value is not None and not np.isnan(value) for value in map(dialect.number, cells))


def _is_sample(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> bool:
    values = _numbers(dialect, cells, numeric)
    return len(cells) == len(numeric) and None not in values and not all(np.isnan(v) for v in values if v is not None)


def _holds_numbers(dialect: Dialect, cells: Sequence[str], numeric: Sequence[bool]) -> bool:
    """Whether most of a line's cells are numbers where a sample has numbers."""
    values = _numbers(dialect, cells, numeric)
    count = sum(value is not None and not np.isnan(value) for value in values)
    return values[:1] != [None] and 2 * count > len(values) and (len(cells) == len(numeric) or count == len(cells))


def _names(heads: labview.Heads, dialect: Dialect, width: int) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Names of the columns, their units, and whether they are pairs of time and value as TwinCAT Scope writes them.

    The names are the nearest of `_heads` that holds no units.
    """
    labelled = {row[0]: tuple(row) for row in heads if row[::2] == row[:1] * (width // 2) and width % 2 == 0}
    if _SCOPE in labelled and "Name" in labelled:
        return labelled["Name"], labelled.get("Unit", ("",) * width), True
    if labview.wrote(heads):
        return *labview.columns(heads), False
    words = [row for row in heads if sum(_is_word(dialect, cell) for cell in row) * 2 > width]
    units = ("",) * width
    if len(words) > 1 and all(_is_unit(cell) for cell in words[0]):
        units = tuple(cell.strip("[]()") for cell in words.pop(0))
    names = tuple(words[0]) if words else ()
    if len(words) > 1 and len(set(names)) < len(names):  # Names below those of groups, as pandas writes two levels.
        names = tuple(".".join(filter(None, pair)) for pair in zip(words[1], names, strict=True))
    return names, units, False


def _heads(above: Sequence[Line], dialect: Dialect, width: int, blank: bool) -> list[list[str]]:
    """Cells of the lines above the numbers that have one for each column, the nearest first.

    They may stand behind a comment mark (numpy.savetxt, gnuplot). Either they or the numbers may end with a separator,
    after which the last column is `blank`.
    """
    rows = []
    for line in reversed(above):
        text = line.text.strip()
        plain = text.lstrip("".join(COMMENTS)).strip()
        cells = dialect.split(line.text if plain == text else plain)
        if plain != text and len(cells) != width:
            cells = plain.replace(",", " ").split()
        while len(cells) > width and (not cells[-1] or cells[-1].lower() == _NO_CHANNEL):
            cells.pop()
        if blank and len(cells) == width - 1:
            cells.append("")
        if len(cells) == width and any(cells):
            rows.append(cells)
    return rows


def _is_unit(cell: str) -> bool:
    """Whether a cell below a name is a unit, with or without brackets; it may be empty."""
    unit = cell.strip("[]()")
    return bool(_UNIT_CELL.match(cell) or unit_name(unit) or is_foreign(unit) or is_ratio(unit))


def _is_word(dialect: Dialect, cell: str) -> bool:
    """Whether a cell above the numbers is a name or a unit; `-` is the unit of a ratio."""
    return dialect.number(cell) is None or is_missing(cell)


def _named(
    path: Path, columns: Sequence[Column], names: Sequence[str], units: Sequence[str], remarks: tuple[str, ...]
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


def _of_states(path: Path, columns: Sequence[Column], states: JointStates, remarks: tuple[str, ...]) -> Recording:
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


def _pairs(path: Path, columns: Sequence[Column], names: Sequence[str], units: Sequence[str]) -> Recording:
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
