"""Base classes of departures from the nominal model. Each hook returns its argument unchanged unless overridden."""

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
    """An effect of the plant that the nominal model lacks. `size` scales it; at zero it is absent.

    `index` holds the joints or tendons of `site` as indices, in the same order.
    """

    size: float
    site: tuple[str, ...]
    index: tuple[int, ...]
    form: str
    shape: dict[str, float]  # further parameters, drawn once

    effect: ClassVar[str]
    listed: ClassVar[bool] = True  # The catalogue has it.
    units: ClassVar[str] = ""  # of the size
    start_size: ClassVar[float]  # where the calibration begins
    largest: ClassVar[float]  # physical limits of the size
    smallest: ClassVar[float] = 1e-12
    forms: ClassVar[tuple[str, ...]]
    foreign: ClassVar[tuple[str, ...]] = ()  # forms of the split `foreign` only

    def known(self) -> dict[str, float]:
        """True values of the catalogue's parameters, where the form is the catalogue's own; else none."""
        return {}

    def resized(self, size: float) -> Departure:
        """Copy of the departure with another size."""
        return replace(self, size=size)

    def body(self, finger: FingerDescription) -> FingerDescription:
        """Rigid body and mounting."""
        return finger

    def path(self, finger: Finger, s: Situation, length: np.ndarray, arm: np.ndarray):
        """Excursion (..., n), m, and moment arms (..., n, m), m/rad."""
        return length, arm

    def passive(self, finger: Finger, s: Situation, torque: np.ndarray) -> np.ndarray:
        """Elastic and viscous torque (..., m), N m."""
        return torque

    def coulomb(self, finger: Finger, s: Situation, limit: np.ndarray, decided: np.ndarray):
        """Limit of the joints' dry friction, and friction that a state determines, (..., m), N m."""
        return limit, decided

    def loss(self, finger: Finger, s: Situation, limit: np.ndarray, decided: np.ndarray):
        """Limit of the tendons' dry friction, and friction that a state determines, (..., n), N."""
        return limit, decided

    def deliver(self, finger: Finger, s: Situation, reaching: np.ndarray) -> np.ndarray:
        """Tension that acts on the joints (..., n), N."""
        return reaching

    def at_motor(self, finger: Finger, s: Situation, torque: np.ndarray) -> np.ndarray:
        """Torque at the external motor's sensor (N, m), N m."""
        return torque

    def contact(self, finger: Finger, s: Situation, force: np.ndarray) -> np.ndarray:
        """Force on the fingertip (N, 3), N."""
        return force

    def read(self, channels: Channels) -> Channels:
        """Channels as the sensors read them, without noise."""
        return channels


@dataclass(frozen=True, eq=False)
class Memory(Departure, ABC):
    """A departure with a state of size k, which `inputs` drive along the motion."""

    states: ClassVar[int] = 1

    @abstractmethod
    def inputs(self, finger: Finger, s: Situation) -> np.ndarray:
        """Inputs (..., i) of the state. They must not depend on the state."""

    def start(self, u: np.ndarray) -> np.ndarray:
        """State (..., k) at a trial's first sample. u: the inputs that are known, time first."""
        return np.zeros((*u.shape[1:-1], self.states))

    @abstractmethod
    def step(self, z: np.ndarray, before: np.ndarray, now: np.ndarray, dt: float) -> np.ndarray:
        """State (..., k) one sample later. dt: s."""

    def state(self, s: Situation) -> np.ndarray:
        """State (..., k) of the departure."""
        return s.memory[id(self)]


def add_at(array: np.ndarray, k: int, value: np.ndarray | float) -> np.ndarray:
    """Copy an array with `value` added to column k."""
    out = np.array(array, dtype=float)
    out[..., k] += value
    return out


def put_at(array: np.ndarray, k: int, value: np.ndarray) -> np.ndarray:
    """Copy an array with column k replaced."""
    out = np.array(array, dtype=float)
    out[..., k] = value
    return out
