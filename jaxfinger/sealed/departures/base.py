"""What a departure from the nominal model may touch. Each hook returns its argument unchanged unless overridden."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from jaxfinger.data import FingerDescription

if TYPE_CHECKING:
    from ..laws import Finger, Situation
    from ..record import Channels


@dataclass(frozen=True, eq=False)
class Departure:
    """One thing that the nominal model leaves out. `size` scales it; at zero it is absent.

    `index` holds the site as indices of joints or tendons, in the order of `site`.
    """

    size: float
    site: tuple[str, ...]
    index: tuple[int, ...]
    form: str
    shape: dict[str, float]  # drawn once: everything but the size

    effect: ClassVar[str]
    listed: ClassVar[bool] = True
    units: ClassVar[str] = ""
    start_size: ClassVar[float]  # where the calibration begins
    largest: ClassVar[float]  # not physical beyond
    smallest: ClassVar[float] = 1e-12  # nor below
    forms: ClassVar[tuple[str, ...]]
    foreign: ClassVar[tuple[str, ...]] = ()  # forms of the split `foreign` alone

    def known(self) -> dict[str, float]:
        """Parameters of the catalogue with their true values, where the form is the catalogue's own; else none."""
        return {}

    def resized(self, size: float) -> Departure:
        """The same departure with another size."""
        return replace(self, size=size)

    def body(self, finger: FingerDescription) -> FingerDescription:
        return finger

    def path(self, finger: Finger, s: Situation, length: np.ndarray, arm: np.ndarray):
        return length, arm

    def passive(self, finger: Finger, s: Situation, torque: np.ndarray) -> np.ndarray:
        return torque

    def coulomb(self, finger: Finger, s: Situation, limit: np.ndarray, decided: np.ndarray):
        return limit, decided

    def loss(self, finger: Finger, s: Situation, limit: np.ndarray, decided: np.ndarray):
        return limit, decided

    def deliver(self, finger: Finger, s: Situation, reaching: np.ndarray) -> np.ndarray:
        return reaching

    def at_motor(self, finger: Finger, s: Situation, torque: np.ndarray) -> np.ndarray:
        """Torque at the external motor's sensor, (N, m)."""
        return torque

    def contact(self, finger: Finger, s: Situation, force: np.ndarray) -> np.ndarray:
        """Force on the fingertip, (N, 3)."""
        return force

    def read(self, channels: Channels) -> Channels:
        """What the sensors make of the true channels."""
        return channels


@dataclass(frozen=True, eq=False)
class Memory(Departure, ABC):
    """A departure with a state that is driven along the motion by `inputs`."""

    states: ClassVar[int] = 1

    @abstractmethod
    def inputs(self, finger: Finger, s: Situation) -> np.ndarray:
        """(..., i), what drives the state; must not use the state itself."""

    def start(self, u: np.ndarray) -> np.ndarray:
        """(..., k) at a trial's first sample; u holds all of the trial that is known, time first."""
        return np.zeros((*u.shape[1:-1], self.states))

    @abstractmethod
    def step(self, z: np.ndarray, before: np.ndarray, now: np.ndarray, dt: float) -> np.ndarray:
        """(..., k) one sample later."""

    def state(self, s: Situation) -> np.ndarray:
        return s.memory[id(self)]


def add_at(array: np.ndarray, k: int, value: np.ndarray | float) -> np.ndarray:
    """A copy of the array with `value` added to column k."""
    out = np.array(array, dtype=float)
    out[..., k] += value
    return out


def put_at(array: np.ndarray, k: int, value: np.ndarray) -> np.ndarray:
    """A copy of the array with column k replaced."""
    out = np.array(array, dtype=float)
    out[..., k] = value
    return out
