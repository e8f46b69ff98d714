"""Every notebook runs from its first cell to its last, and its assertions hold."""

from pathlib import Path

import jupytext
import pytest

pytestmark = pytest.mark.long

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path):
    cells = jupytext.read(path).cells
    assert {c.cell_type for c in cells} == {"code", "markdown"}
    scope: dict = {"__name__": "__main__"}
    for cell in cells:
        if cell.cell_type == "code":
            exec(compile(cell.source, str(path), "exec"), scope)
