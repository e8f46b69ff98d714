"""The room shares no code with the model and the diagnosis that it tests."""

import ast
import subprocess
import sys
from pathlib import Path

import jaxfinger.sealed

ROOM = Path(jaxfinger.sealed.__file__).parent
ALLOWED = ("jaxfinger.data", "jaxfinger.errors", "jaxfinger.sealed")


def test_imports_only_data():
    for file in ROOM.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            for name in names:
                if name.startswith("jaxfinger"):
                    assert name.startswith(ALLOWED), f"{file.name} imports {name}"
                assert name.split(".")[0] not in ("jax", "equinox", "diffrax"), f"{file.name} imports {name}"


def test_nothing_of_the_model_is_loaded_to_make_or_score_a_case():
    code = (
        "import sys, jaxfinger.sealed.cases, jaxfinger.sealed.run, jaxfinger.sealed.score\n"
        "rooms = 'jaxfinger.model', 'jaxfinger.effects', 'jaxfinger.gap', 'jax.'\n"
        "bad = [m for m in sys.modules if m.startswith(rooms)]\n"
        "print(bad)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
