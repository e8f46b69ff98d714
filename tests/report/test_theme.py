"""Colours that all eyes tell apart, in both modes; and figures that take a page's colours."""

from itertools import combinations

import numpy as np
import pytest

from jaxfinger.report.theme import (
    BACKGROUND,
    INK_,
    LINK,
    MUTED_,
    PALETTE,
    PANEL,
    WRONG_,
    axes_or_new,
    css,
    inline,
)

# Machado, Oliveira & Fernandes, IEEE Trans. Vis. Comput. Graph. 15 (2009) 1291, severity 1, on linear RGB.
EYES = {
    "normal": np.eye(3),
    "protanopia": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "deuteranopia": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    "tritanopia": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
}
APART = 12.0  # ΔE (CIE 1976): about five just noticeable differences
MODES = ("light", "dark")


def _linear(colour: str) -> np.ndarray:
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _lab(rgb: np.ndarray) -> np.ndarray:
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x = to_xyz @ np.clip(rgb, 0, 1) / [0.9505, 1.0, 1.089]
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def _contrast(a: str, b: str) -> float:
    dark, light = sorted(_linear(c) @ [0.2126, 0.7152, 0.0722] for c in (a, b))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("eyes", EYES)
def test_all_eyes_tell_the_palette_apart(mode, eyes):
    seen = {c.name: _lab(np.array(EYES[eyes]) @ _linear(getattr(c, mode))) for c in PALETTE}
    for a, b in combinations(seen, 2):
        assert np.linalg.norm(seen[a] - seen[b]) > APART, (a, b)


@pytest.mark.parametrize("mode", MODES)
def test_text_and_lines_stand_out(mode):
    """WCAG 2.2: 4.5 for text (1.4.3), 3 for graphics (1.4.11); the last colour, a filled one, has 2.5."""
    for ground in (BACKGROUND, PANEL):
        for c in (INK_, MUTED_, WRONG_, LINK):
            assert _contrast(getattr(c, mode), getattr(ground, mode)) >= 4.5, c.name
    for c in PALETTE:
        assert _contrast(getattr(c, mode), getattr(BACKGROUND, mode)) >= (2.5 if c.name == "sky" else 3.0), c.name


def test_nothing_of_the_palette_is_red():
    for c in PALETTE:
        red, green, blue = (int(c.light[i : i + 2], 16) for i in (1, 3, 5))
        assert not (red > 150 and green < 80 and blue < 80), c.name


def test_a_figure_in_a_page_takes_its_colours_and_keeps_its_ids_apart():
    ax = axes_or_new(None, 3.0, 2.0)
    ax.plot([0, 1], [0, 1], "o-", color=PALETTE[0].light, label="a & b")
    ax.legend()
    first, second = inline(ax.figure, "one", "says «x»"), inline(ax.figure, "two", "")
    assert "var(--blue)" in first
    assert "var(--ink)" in first
    assert PALETTE[0].light not in first
    assert 'aria-label="says «x»"' in first
    ids = [{part.split('"')[0] for part in text.split(' id="')[1:]} for text in (first, second)]
    assert ids[0]
    assert not ids[0] & ids[1]
    for text, own in zip((first, second), ids, strict=True):
        used = {part.split('"')[0] for part in text.split('href="#')[1:]}
        used |= {part.split(")")[0] for part in text.split("url(#")[1:]}
        assert used <= own
    assert "prefers-color-scheme: dark" in css()
