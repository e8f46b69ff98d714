"""CSV of `ros2 topic echo --csv` on a topic of sensor_msgs/JointState, whose lines say what their cells are.

The command writes no names of columns. Each line is a message with its fields one after another, an array as its
values and an empty array or text as one empty cell:

    sec, nanosec, frame_id, the names, then as many positions, velocities and efforts

With the option `-i` four cells of the middleware stand before them: the times of sending and receipt, and two
counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfinger.data.importing.recording import Variable

_BEFORE_NAMES = 3  # cells: sec, nanosec and frame_id
_INFO = 4  # cells of the middleware
_FIELDS = ("position", "velocity", "effort")
_NS = 1e-9
# ns. A clock of messages ticks by a millisecond or less, so that some stamp is so far beyond its second. In a table of
# other numbers the second column may count from zero, and stays below.
_MIN_NS = 10**6
_MIN_EPOCH_NS = 10**17  # ns since 1970, in 1973: seconds, and counts of any log, stay below.


class JointStates(NamedTuple):
    """Names of the joints, and the first column of each field that is there; each has a column a joint.

    `first` is the column of the stamps' seconds.
    """

    names: tuple[str, ...]
    fields: Mapping[str, int]
    first: int

    def variables(self, columns: Sequence[Float[np.ndarray, " N"]]) -> dict[str, Variable]:
        """Stamps, s, and fields of the messages, of the columns of the table. Those of words are not read."""
        tables = {field: columns[first : first + len(self.names)] for field, first in self.fields.items()}
        stamp = Variable(columns[self.first] + _NS * columns[self.first + 1], units="s")
        return {"stamp": stamp, **{field: Variable(np.stack(x, axis=1), self.names) for field, x in tables.items()}}


def joint_states(rows: Sequence[Sequence[str]], number: Callable[[str], float | None]) -> JointStates | None:
    """What the cells of some lines are, if each is a JointState; None if not. `number` gives the number in a cell."""
    first = _INFO if _has_info(rows) else 0
    rows = [row[first:] for row in rows]
    cells = rows[0]
    if len(cells) < _BEFORE_NAMES or not all(cell.isdecimal() for row in rows for cell in row[:2]):
        return None
    beyond = [int(row[1]) for row in rows]
    names = tuple(takewhile(lambda cell: number(cell) is None, cells[_BEFORE_NAMES:]))
    values = cells[_BEFORE_NAMES + len(names) :]
    if not _MIN_NS <= max(beyond) < 1.0 / _NS or (cells[2] and number(cells[2]) is not None):
        return None
    if not names or len(set(names)) < len(names) or any(number(cell) is None for cell in values):
        return None
    at, fields = 0, {}
    for field in _FIELDS:
        if at < len(values) and values[at]:
            fields[field] = first + _BEFORE_NAMES + len(names) + at
        at += len(names) if field in fields else 1
    return JointStates(names, fields, first) if at == len(values) and fields else None


def _has_info(rows: Sequence[Sequence[str]]) -> bool:
    """Whether each line begins with two times in ns since 1970."""
    return all(cell.isdecimal() and int(cell) > _MIN_EPOCH_NS for row in rows for cell in row[:2])
