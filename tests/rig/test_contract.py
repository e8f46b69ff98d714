"""Document, Structured Text and adapter agree on fields, types, sizes and codes."""

import re
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.rig import contract
from jaxfinger.rig.contract import Kind, State, Trip

DOCS = Path(__file__).parents[2] / "docs"
TYPES = {"ULINT": "<u8", "UDINT": "<u4", "DINT": "<i4", "LREAL": "<f8"}
STRUCTS = {
    "ST_Sample": contract.SAMPLE,
    "ST_Status": contract.STATUS,
    "ST_Info": contract.INFO,
    "ST_Limits": contract.LIMITS,
    "ST_Filter": contract.FILTER,
    "ST_Command": contract.COMMAND,
}


def structured_text() -> dict[str, list[tuple[str, np.dtype]]]:
    found = {}
    text = (DOCS / "JaxfingerRing.st").read_text(encoding="utf-8")
    for name, body in re.findall(r"TYPE (\w+) :\s*STRUCT(.*?)END_STRUCT", text, re.S):
        rows = []
        for field, kind in re.findall(r"^\s*(\w+)\s*:\s*(.+?);", body, re.M):
            array = re.match(r"ARRAY \[0\.\.(\d+)\] OF (\w+)", kind)
            string = re.match(r"STRING\((\d+)\)", kind)
            if array:
                rows.append((field, np.dtype((TYPES[array[2]], int(array[1]) + 1))))
            else:
                rows.append((field, np.dtype(f"S{int(string[1]) + 1}") if string else np.dtype(TYPES[kind])))
        found[name] = rows
    return found


@pytest.mark.parametrize("name", STRUCTS)
def test_structured_text_has_the_adapters_layout(name):
    """TwinCAT aligns each field to its own size, up to 8 bytes, and the structure to its largest field."""
    rows, dtype = structured_text()[name], STRUCTS[name]
    assert len(rows) == len(dtype.names)
    offset = 0
    for (_, kind), wanted in zip(rows, dtype.names, strict=True):
        size = 1 if kind.kind == "S" else min(kind.base.itemsize, 8)
        offset = -(-offset // size) * size
        assert kind == dtype[wanted] or (kind.base == dtype[wanted].base and kind.shape == dtype[wanted].shape)
        assert offset == dtype.fields[wanted][1]
        offset += kind.itemsize
    assert -(-offset // 8) * 8 == dtype.itemsize


def test_the_document_names_every_symbol_with_its_size():
    text = (DOCS / "plc-contract.md").read_text(encoding="utf-8")
    for symbol, (dtype, count) in contract.SYMBOLS.items():
        row = next((line for line in text.splitlines() if line.startswith(f"| `{symbol}` ")), None)
        if symbol == "stBench":
            assert row is None  # only the stand-in has it
        else:
            assert row is not None
            assert int(row.split("|")[3].replace("\u202f", "").replace(" ", "")) == dtype.itemsize * count
    skeleton = (DOCS / "JaxfingerRing.st").read_text(encoding="utf-8")
    assert "aRing     : ARRAY [0..16383] OF ST_Sample" in skeleton


def test_the_document_has_the_codes():
    text = (DOCS / "plc-contract.md").read_text(encoding="utf-8")
    for kind in list(Kind)[1:]:
        assert f"| {kind.value} | {kind.name} |" in text
    for state in State:
        assert re.search(rf"{state.name} {state.value}\b", text), state
    for trip in (t for t in Trip if 0 < t < 20):
        assert f"| {trip.value} |" in text
        assert trip.sentence


def test_document_and_skeleton_state_the_adapters_version():
    text, skeleton = ((DOCS / name).read_text(encoding="utf-8") for name in ("plc-contract.md", "JaxfingerRing.st"))
    assert f"`nVersion` UDINT = {contract.VERSION} " in text
    assert re.search(r"stInfo\.nVersion +:= (\d+);", skeleton)[1] == str(contract.VERSION)
    versions = [int(row) for row in re.findall(r"^\| (\d+) \| Release", text, re.MULTILINE)]
    assert versions == list(range(contract.VERSION, 0, -1))


def test_every_field_lies_on_its_natural_boundary():
    for dtype, _ in contract.SYMBOLS.values():
        for kind, offset, *_ in (dtype.fields or {}).values():
            assert offset % min(kind.base.itemsize, 8) == 0 or kind.kind == "S"
        assert dtype.itemsize % 8 == 0
