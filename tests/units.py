"""Conversion of sessions and numbers to other units of mass, length and time."""

import re
from dataclasses import dataclass, replace

import numpy as np

from jaxfinger.data import Session, Trial


@dataclass(frozen=True)
class Scale:
    """Factors from SI to other units of mass, length and time."""

    mass: float = 1.0
    length: float = 1.0
    time: float = 1.0

    @property
    def force(self) -> float:
        return self.mass * self.length / self.time**2

    def of(self, units: str) -> float:
        """Factor of a number with these units, in the notation of parameters, as `N m s/rad^2`."""
        base = {"kg": self.mass, "m": self.length, "s": self.time, "N": self.force, "rad": 1.0, "1": 1.0}
        out, (above, _, below) = 1.0, units.partition("/")
        for text, sign in ((above, 1), (below, -1)):
            for name, power in re.findall(r"([A-Za-z]+|^1$)\^?(-?\d*)", text):
                out *= base[name] ** (sign * int(power or 1))
        return out

    def __call__(self, session: Session) -> Session:
        """Session with the same motions and forces in the other units."""
        f = session.finger
        slides = np.array(f.prismatic)
        angle = np.where(slides, self.length, 1.0)  # of each joint's coordinate
        torque = np.where(slides, self.force, self.force * self.length)
        powers = 0 if f.excursion is None else np.arange(1, f.excursion.shape[2] + 1)  # of q in the excursions
        excursion = self.length / angle[:, None] ** powers
        rotor = np.where(slides, self.mass, self.mass * self.length**2)
        finger = replace(
            f,
            gravity=f.gravity * self.length / self.time**2,
            origin=f.origin * self.length,
            limits=f.limits * angle[:, None],
            fingertip=f.fingertip * self.length,
            mass=f.mass * self.mass,
            mass_std=_by(self.mass, f.mass_std),
            com=f.com * self.length,
            com_std=_by(self.length, f.com_std),
            inertia=f.inertia * self.mass * self.length**2,
            rotor_inertia=_by(rotor, f.rotor_inertia),
            rotor_inertia_std=_by(rotor, f.rotor_inertia_std),
            excursion=_by(excursion, f.excursion),
            excursion_std=_by(excursion, f.excursion_std),
        )

        def scaled(t: Trial) -> Trial:
            return replace(
                t,
                time=t.time * self.time,
                q=t.q * angle,
                session_start=_by(self.time, t.session_start),
                tendon_force=_by(self.force, t.tendon_force),
                tendon_excursion=_by(self.length, t.tendon_excursion),
                joint_torque=_by(torque, t.joint_torque),
                fingertip_force=_by(self.force, t.fingertip_force),
            )

        return replace(session, finger=finger, trials={name: scaled(t) for name, t in session.trials.items()})


def _by(factor, values):
    return None if values is None else values * factor
