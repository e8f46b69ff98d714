"""Play a recorded trial back as if it came from a rig, to view it live or to supervise it again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxfinger.data import Trial, read_session
from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Block, Command, CommandRefused, EndOfReplay, Rig, Status
from jaxfinger.rig.channels import Filter, RigChannel, RigDescription
from jaxfinger.rig.contract import State, Trip

BLOCK_SAMPLES = 50  # samples in a block: as many as 50 ms (poll_s) give at 1 kHz


@dataclass(frozen=True)
class Address:
    """Keys of `[address]`: `file`, a session relative to the rig file, and the name of a `trial` in it."""

    file: str
    trial: str


class ReplayRig(Rig):
    """The blocks of a recorded trial, in state ARMED, with the channels that it measured.

    Commands are refused. Stop and release have nothing to act on.
    """

    synchronous = True
    simulated_time = True

    def __init__(self, description: RigDescription):
        self.description = description
        self._path = (Path(description.path).parent / str(description.address["file"])).resolve()
        self._at = 0

    def connect(self) -> None:
        path, name = self._path, str(self.description.address["trial"])
        session = read_session(path)
        if name not in session.trials:
            raise UserError(f"{path}: has no trial '{name}'; choose one of {', '.join(session.trials)}.")
        trial, finger = session[name], session.finger
        measured: list[RigChannel] = []
        columns: list[np.ndarray] = []
        for channel in self.description.channels:
            column = _column(trial, channel, finger.joint_names, finger.tendon_names)
            if column is not None and not np.isnan(column).all():
                measured.append(channel)
                columns.append(column)
        self.description = replace(self.description, channels=tuple(measured), finger=finger)
        self._time = np.round(trial.time * 1e9).astype(np.uint64)
        self._x = np.stack(columns, 1)
        self._at = 0

    def close(self) -> None:
        pass

    def poll(self) -> Block:
        part = slice(self._at, self._at + BLOCK_SAMPLES)
        t_ns, x = self._time[part], self._x[part]
        if not len(x):
            raise EndOfReplay("the recording is at its end.")
        seq = np.arange(self._at, self._at + len(x), dtype=np.uint64)
        self._at += len(x)
        state = np.full(len(x), State.ARMED, np.uint32)
        return Block(seq, t_ns, x.copy(), state, np.zeros(len(x), np.uint32))

    def beat(self) -> None:
        pass

    def rewind(self, seq: int) -> None:
        self._at = min(max(seq, 0), len(self._x))

    def command(self, command: Command) -> int:
        raise CommandRefused("a recording cannot be moved; use the backend 'simulated' or 'ads'.")

    def arm(self) -> int:
        raise CommandRefused("a recording cannot be armed; use the backend 'simulated' or 'ads'.")

    def release(self) -> int:
        return 0

    def stop(self, cause: Trip) -> None:
        pass

    def reset(self, operator: str) -> int:
        return 0

    def status(self) -> Status:
        return Status(State.IDLE, head=self._at)

    def filters(self) -> dict[str, Filter]:
        return {}

    def fingerprint(self) -> dict[str, str]:
        return {"replay": str(self._path)}


def _column(trial: Trial, channel: RigChannel, joints: tuple[str, ...], tendons: tuple[str, ...]) -> np.ndarray | None:
    """Return the trial's values (N,) of a channel, or None. External torque is that of the trial's joint."""
    array, names = {
        "tension": (trial.tendon_force, tendons),
        "excursion": (trial.tendon_excursion, tendons),
        "joint_position": (trial.q, joints),
        "fingertip_force": (trial.fingertip_force, ("x", "y", "z")),
        "external_torque": (trial.joint_torque, joints),
    }.get(channel.kind, (None, ()))  # Channels of SAFETY_KINDS are in no session.
    of = channel.of or (trial.joint or "")
    return array[:, names.index(of)] if array is not None and of in names else None


def make(description: RigDescription) -> ReplayRig:
    """Return the rig of a rig file."""
    return ReplayRig(description)
