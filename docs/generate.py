"""Write the pages and drawings that follow from the code while the site is built: commands, causes, experiments."""

import inspect
import io

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import mkdocs_gen_files
import numpy as np

from jaxfinger.cli.app import app
from jaxfinger.effects import CATALOGUE, NOMINAL_TERMS

# Joints that move and joints that a fixture holds, the tension of the tendons, and the sensors, of each experiment.
EXPERIMENTS = {
    "ID.2": dict(moving=(1,), held=(0, 2), tendon="2 N", motor=False, force=False),
    "ID.3-static": dict(moving=(0,), held=(1, 2), tendon="slack", motor=True, force=False),
    "ID.3-dynamic": dict(moving=(0,), held=(1, 2), tendon="slack", motor=True, force=False),
    "ID.4": dict(moving=(), held=(0, 1, 2), tendon="2 … 12 N in steps", motor=True, force=False),
    "VD.1": dict(moving=(0, 1, 2), held=(), tendon="2 N", motor=False, force=False),
    "VD.2": dict(moving=(), held=(), tendon="4 … 15 N in steps", motor=False, force=True),
    "VD.3": dict(moving=(0, 1, 2), held=(), tendon="drives the finger", motor=False, force=False),
}


def finger(angles: tuple[float, ...]) -> np.ndarray:
    """Positions of the joints and the tip of a planar finger that flexes downwards, cm."""
    lengths, heading = (4.3, 2.7, 2.3), -np.cumsum(angles)
    steps = [np.array([length * np.cos(h), length * np.sin(h)]) for length, h in zip(lengths, heading, strict=True)]
    return np.cumsum([np.zeros(2), *steps], axis=0)


def draw(name: str, moving: tuple, held: tuple, tendon: str, motor: bool, force: bool) -> str:
    """Draw an experiment as an SVG. Hollow joints are held; the light finger shows the motion."""
    figure, axes = plt.subplots(figsize=(4.6, 2.7))
    pose, other = (0.25, 0.5, 0.35), tuple(a + 0.45 * (j in moving) for j, a in enumerate((0.25, 0.5, 0.35)))
    places = finger(pose)
    if moving:
        axes.plot(*finger(other).T, color="0.78", lw=7, solid_capstyle="round", zorder=1)
    axes.plot(*places.T, color="0.45", lw=9, solid_capstyle="round", zorder=2)
    below = places + np.array([-0.1, -0.62])
    path = np.vstack([(-2.2, -0.62), below[:-1], places[-1]])
    axes.plot(*path.T, color="C0", lw=1.6, zorder=3)
    axes.annotate(f"tendon: {tendon}", (-2.2, -0.62), (-2.4, -2.1), color="C0", fontsize=10)
    for j, place in enumerate(places[:-1]):
        axes.plot(*place, "o", ms=11, mec="k", mfc="w" if j in held else "k", zorder=4)
        axes.annotate(("MCP", "PIP", "DIP")[j], place, (-10, 13), textcoords="offset points", fontsize=10)
    if motor:
        axes.plot(*places[0], "s", ms=24, mec="C1", mfc="none", mew=2, zorder=5)
        label = "motor with torque sensor"
        axes.annotate(label, places[0], (-60, 34), textcoords="offset points", color="C1", fontsize=10)
    if force:
        tip = places[-1]
        axes.annotate("", tip, tip + np.array([0.4, -1.7]), arrowprops=dict(arrowstyle="->", color="C2", lw=2))
        axes.annotate("force sensor", tip + np.array([-1.0, -2.3]), color="C2", fontsize=10)
    axes.set(xlim=(-2.8, 10.2), ylim=(-6.2, 2.6), aspect="equal")
    axes.axis("off")
    text = io.StringIO()
    figure.savefig(text, format="svg", bbox_inches="tight", transparent=False)
    plt.close(figure)
    return text.getvalue()


for name, what in EXPERIMENTS.items():
    with mkdocs_gen_files.open(f"drawings/{name}.svg", "w") as file:
        file.write(draw(name, **what))

with mkdocs_gen_files.open("commands.md", "w") as file:
    file.write(app.generate_docs(recursive=True, include_hidden=False))

with mkdocs_gen_files.open("causes.md", "w") as file:
    file.write(
        "# The catalogue of causes\n\nEffects that the nominal model leaves out, as `jaxfinger effects` prints them.\n"
    )
    for effect in (CATALOGUE | NOMINAL_TERMS).values():
        file.write(f"\n## `{effect.ID}`\n\nAt a {effect.PLACE.replace('_', ' ')}. {inspect.getdoc(effect)}\n\n")
        for title, text in (
            ("What happens", effect.HAPPENS),
            ("What it looks like", effect.LOOKS),
            ("What to change", effect.CHANGE),
        ):
            file.write(f"- **{title}.** {text}\n")
