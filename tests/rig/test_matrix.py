"""The fault matrix: the supervisor alone on streams of samples, and the recorder against the stand-in."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from jaxfinger.rig.matrix import (
    BEGIN,
    BLOCK_SIZES,
    MATRIX,
    OFF_S,
    PHASES,
    STOP_S,
    blocks,
    run,
    stopped_s,
    stream,
    table,
)
from jaxfinger.rig.safety import Supervisor
from tests.rig.wire import Cell, try_cell

RECORDING = Path(__file__).parents[2] / "docs" / "recording.md"
STREAMS = [row for row in MATRIX if row.spoil is not None]


@pytest.fixture(scope="module")
def results(rig):
    return run(rig)


@pytest.mark.parametrize("row", STREAMS, ids=lambda row: row.name)
def test_the_supervisor_finds_each_fault_at_the_same_sample_in_blocks_of_any_size(rig, results, row):
    assert {size for name, _, size in results if name == row.name} == set(BLOCK_SIZES)
    for phase in row.phases:
        hits = [results[row.name, phase, size] for size in BLOCK_SIZES]
        assert all(hits), phase
        violations, arrived = zip(*hits, strict=True)
        assert violations[0].trip in row.causes, (phase, violations[0])
        assert {v.seq for v in violations} == {violations[0].seq}
        since = (violations[0].seq - BEGIN) / rig.rate_hz
        assert 0 <= since <= row.shows(rig) + 0.1
        assert max(arrived) - violations[0].seq < max(BLOCK_SIZES)


@pytest.mark.parametrize("phase", PHASES)
def test_a_sound_finger_trips_nothing_in_any_phase(rig, phase):
    supervisor = Supervisor(rig)
    assert [v for block in blocks(stream(rig, phase), 50) for v in supervisor.check(block)] == []


def test_every_row_keeps_the_limits(rig, results):
    for row in MATRIX:
        stop = stopped_s(rig, row, results)
        assert stop <= STOP_S, row.name
        assert stop + (0.0 if row.at_once else 0.7) <= OFF_S, row.name


def test_the_documents_table_is_the_matrix(rig, results):
    assert table(rig, results) in RECORDING.read_text(encoding="utf-8")


# One phase and one pause between reads for each row; a pause of 1 ms gives blocks of a sample or two. Always tried are
# the connection and the operator; the others are long tests.
CELLS = [Cell("cut"), Cell("key", "ramp"), Cell("mute")]
LONG_CELLS = [
    Cell("reader"), Cell("runner"), Cell("watch"), Cell("full"), Cell("disk"), Cell("stall"), Cell("call"),
    Cell("beat"), Cell("deaf"), Cell("lag"), Cell("slow"), Cell("restart"), Cell("flicker", "ramp", 0.001),
    Cell("nan", "letting go"), Cell("temperature", "hold", 0.01, ("delay=0.01",)), Cell("clock fast", "arming"),
]  # fmt: skip
LANES = 3  # cells at a time; each sleeps most of its time


@contextmanager
def begun(cells):
    """Begin cells over the wire. Yield the future result of each."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(LANES - 1, context) as pool, ProcessPoolExecutor(1, context) as other:
        # A call that hangs keeps its connection for as long as its process lives.
        yield {cell: (other if cell.row in ("call", "beat") else pool).submit(try_cell, cell) for cell in cells}


@pytest.fixture(scope="module")
def over_the_wire():
    with begun(CELLS) as results:
        yield results


@pytest.fixture(scope="module")
def long_over_the_wire():
    with begun(LONG_CELLS) as results:
        yield results


def name(cell):
    return f"{cell.row}-{cell.phase}"


@pytest.mark.parametrize("cell", CELLS, ids=name)
def test_the_recorder_lets_go_over_the_wire(over_the_wire, cell):
    """The rig stops, tension is off, data are kept, the cause is named, and the run ends, each within its time."""
    found, faults = over_the_wire[cell].result()
    assert not faults, (faults, found)


@pytest.mark.long
@pytest.mark.parametrize("cell", LONG_CELLS, ids=name)
def test_the_recorder_lets_go_over_the_wire_in_every_other_row(long_over_the_wire, cell):
    found, faults = long_over_the_wire[cell].result()
    assert not faults, (faults, found)


def test_every_row_is_tested_over_the_wire_or_as_a_stream():
    hosts = {"host"}  # test_command_line stops and kills the host
    wire, streams = {c.row for c in (*CELLS, *LONG_CELLS)}, {row.name for row in STREAMS}
    assert {row.name for row in MATRIX} == wire | streams | hosts
