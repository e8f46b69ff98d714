"""What the pages tell a reader to type is a command that there is, with options that it has."""

import re
import shlex
from pathlib import Path

import pytest

from jaxfinger.cli.app import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "datasets").rglob("*.md"))]


def commands(page: Path) -> list[str]:
    """Lines of shell blocks that call jaxfinger."""
    blocks = re.findall(r"```(?:sh|bash|console)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    blocks += re.findall(r"\n\n((?:    [^\n]*\n)+)", page.read_text(encoding="utf-8"))
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("jaxfinger ")]


@pytest.mark.parametrize(
    ("page", "line"), [(p.name, line) for p in PAGES for line in commands(p)], ids=lambda x: x[:60].replace("/", "_")
)
def test_every_command_in_the_docs_is_one(page, line):
    tokens = shlex.split(line, comments=True)[1:]
    app.parse_args(tokens, exit_on_error=False, print_error=False)
