"""Fixtures: the system's Chromium through Playwright, without network, and the pages to look at."""

import shutil

import pytest
from playwright.sync_api import sync_playwright

from jaxfinger.report.page import render

from .fabricated import arms, every, trace

QUIET = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
)


@pytest.fixture(scope="session")
def browser():
    found = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
    if found is None:
        pytest.fail("no chromium on the PATH: the page is tested in a browser; install it (apt-get install chromium)")
    with sync_playwright() as p:
        b = p.chromium.launch(executable_path=found, args=list(QUIET))
        yield b
        b.close()


@pytest.fixture(scope="session")
def pages(tmp_path_factory):
    """Paths of the pages of those diagnoses that together show all sections."""
    folder = tmp_path_factory.mktemp("pages")
    out = {}
    for name in ("partly", "ambiguous", "no_gap", "diverged", "not_judged"):
        d = every()[name]
        out[name] = folder / f"{name}.html"
        found = arms() if name == "partly" else None
        out[name].write_text(render(d, trace() if d.channels else None, found), encoding="utf-8")
    return out
