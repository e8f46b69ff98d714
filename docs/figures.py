"""Make the picture at the top of README: `python docs/figures.py`."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import jaxfinger as jf

HERE = Path(__file__).parent

if __name__ == "__main__":
    session = jf.read(HERE.parent / "datasets" / "demo-finger" / "session.h5")
    axes = jf.plot.budget(jf.diagnose(session))
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(HERE / "budget.png", dpi=150, bbox_inches="tight")
