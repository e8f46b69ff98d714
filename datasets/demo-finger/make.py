"""Make `session.h5` and `fresh.h5` beside this file: `python datasets/demo-finger/make.py`.

The plant is that of the sealed cases, a planar finger with two causes that the nominal model lacks.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfinger.data import Session as Recording
from jaxfinger.data import write_session
from jaxfinger.sealed.cases import CREATED, record_trials, with_trajectories
from jaxfinger.sealed.departures.joint import Stribeck
from jaxfinger.sealed.departures.tendon import Stretch
from jaxfinger.sealed.drive import simulate
from jaxfinger.sealed.laws import Finger
from jaxfinger.sealed.protocols import LOGGED, draw_style, session_plans
from jaxfinger.sealed.record import driven
from jaxfinger.sealed.sensors import draw_sensors
from jaxfinger.sealed.specimens import make_specimen

HERE = Path(__file__).parent
CAUSES = (
    Stretch(6e-5, ("T3",), (2,), "linear", {}),  # m/N
    Stribeck(0.9, ("MCP",), (0,), "gaussian", {"v_s": 0.35}),  # share of the Coulomb friction, rad/s
)


def main() -> None:
    """Write both files. With the same libraries they are the same bit for bit."""
    rng = np.random.default_rng(20261125)
    specimen = make_specimen("planar", rng)
    nominal, finger, sensors = Finger(specimen), Finger(specimen, CAUSES), draw_sensors(rng)
    style = replace(draw_style(rng), missing="", postures=1, repeat=0.15, holds=7, levels=5, unload=True)
    style = replace(style, slow=0.5 * LOGGED, fast=LOGGED)
    for file, fresh in (("session.h5", False), ("fresh.h5", True)):
        plans = with_trajectories(nominal, session_plans(specimen, style, rng, fresh), rng)
        moving = [p for p in plans if p.experiment == "VD.3"]
        runs = zip(moving, simulate(finger, nominal, moving), strict=True)
        motions = {plan.seed: driven(run, plan.rate) for plan, run in runs}
        trials = record_trials(finger, plans, motions, sensors, rng.normal(0, 1e-4, finger.n), rng)
        session = Recording(
            specimen="demo finger",
            finger=specimen.cad,
            trials={t.name: t for t in trials},
            source="jaxfinger sealed plant (MuJoCo)",
            created=CREATED,
        )
        write_session(session, HERE / file, overwrite=True)


if __name__ == "__main__":
    main()
