"""Turn a log into a session: trials in the dataset format, and in `/rig` gaps, trips, filters and events."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jaxfinger.data import Session, Trial
from jaxfinger.data.hdf5 import new_file, write_into
from jaxfinger.data.session import FingerDescription
from jaxfinger.errors import UserError, counted
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block
from jaxfinger.rig.channels import SAFETY_KINDS, SI_UNITS, Filter, RigDescription
from jaxfinger.rig.contract import FLAGGED


@dataclass
class Damage:
    """Bytes of a log that are no sound frame, from byte `at` on.

    They lie within `trial`, which lacks `lost` samples there, or between two trials (""). The `left_out` samples that
    follow belong to a trial whose beginning is among the damaged bytes, so nobody knows what they mean.
    """

    at: int
    size: int
    trial: str = ""
    lost: int = 0
    left_out: int = 0

    def __str__(self) -> str:
        lacks = counted(self.lost, "sample") if self.lost else "samples, marks or its end"
        where = f"within {self.trial}, which lacks {lacks} there" if self.trial else "between two trials"
        rest = (
            f"; {counted(self.left_out, 'sample')} of the trial that begins there are left out" if self.left_out else ""
        )
        return f"the log is damaged for {counted(self.size, 'byte')} from byte {self.at} on, {where}{rest}"


@dataclass
class LoggedTrial:
    """One trial of the log: its TRIAL frame, its blocks, its marks, and its END frame (None: it was cut short).

    `damage` lies within it. `hidden` is the most samples that the damage since its last block can have held (None: it
    has no damage since then).
    """

    start: dict[str, Any]
    blocks: list[Block] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    end: dict[str, Any] | None = None
    damage: list[Damage] = field(default_factory=list)
    hidden: int | None = None

    @property
    def name(self) -> str:
        """Name of the trial in the file."""
        return self.start["name"]

    @property
    def complete(self) -> bool:
        """Whether the trial ran to its end, and the log holds all of it."""
        return bool(self.end and self.end["complete"] and not self.damage)

    @property
    def cause(self) -> str:
        """Why the trial was cut short, in words."""
        ended = "the recorder was killed" if self.end is None and not self.damage else (self.end or {}).get("cause", "")
        return "; ".join(filter(None, [str(ended), *map(str, self.damage)]))

    @property
    def last_seq(self) -> int:
        """Number of the last sample so far; of the one before the trial where it has none."""
        return int(self.blocks[-1].seq[-1] if self.blocks else self.start["seq"] - 1)

    def interrupt(self, damage: Damage, most: int) -> None:
        """Take note of damage after the frames so far, which can have held `most` samples.

        It may have held marks too, so no hold is known until the next one.
        """
        self.damage.append(damage)
        self.hidden = (self.hidden or 0) + most
        if self.marks:
            self.marks.append({"seq": self.last_seq + 1, "hold": -1, "joint_direction": {}, "tendon_direction": {}})

    def reaches(self, seq: int, lost: int = 0) -> bool:
        """Whether sample `seq`, before which `lost` samples never reached the log, can belong to the trial.

        Damage may hide the trial's end and the beginning of another one, which comes seconds later.
        """
        return self.hidden is None or self.start["seq"] <= seq <= self.last_seq + 1 + self.hidden + lost

    def add(self, block: Block) -> None:
        """Append a block."""
        if self.hidden is not None:
            self.damage[-1].lost, self.hidden = int(block.seq[0]) - self.last_seq - 1, None
        self.blocks.append(block)


@dataclass
class Log:
    """A log, read: its header, its trials in their order, its events, and where it is damaged between sound frames."""

    header: dict[str, Any]
    trials: list[LoggedTrial]
    events: list[dict[str, Any]]
    damage: list[Damage] = field(default_factory=list)

    @property
    def last_seq(self) -> int | None:
        """Number of the last sample in the log, or None."""
        return next((int(r.blocks[-1].seq[-1]) for r in reversed(self.trials) if r.blocks), None)


def header(rig: RigDescription, plan: str, filters: dict[str, Filter], fingerprint: dict[str, str]) -> dict[str, Any]:
    """First frame of a log: everything that the session file needs besides the samples."""
    finger = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(rig.finger).items()}
    return {
        "specimen": rig.specimen,
        "source": f"rig {rig.name} ({rig.backend})",
        "finger": finger,
        "channels": [asdict(c) for c in rig.channels],
        "rate_hz": rig.rate_hz,
        "rig": rig.text,
        "plan": plan,
        "filters": {name: asdict(f) for name, f in filters.items()},
        "fingerprint": fingerprint,
    }


def read_frames(frames: Iterable[wal.Frame], name: str = "log") -> Log:
    """Group the frames of a log by trial.

    Raises:
        UserError: there is no whole header frame.
    """
    log, trial = Log({}, [], []), None
    for frame in frames:
        if not log.header and frame.tag != wal.HEADER:
            raise UserError(f"{name}: the log's first frame is damaged, so nobody can say what its samples mean.")
        if frame.damaged:
            log.damage.append(Damage(frame.start - frame.damaged, frame.damaged, trial.name if trial else ""))
            if trial is not None:
                trial.interrupt(log.damage[-1], frame.damaged // wal.sample_bytes(len(log.header["channels"])))
        if frame.tag == wal.HEADER:
            log.header = frame.json
        elif frame.tag == wal.TRIAL:
            trial = LoggedTrial(frame.json)
            log.trials.append(trial)
        elif frame.tag == wal.EVENT:
            log.events.append(frame.json)
        elif frame.tag == wal.DATA:
            block = frame.block
            trial = trial if trial is not None and trial.reaches(int(block.seq[0]), block.lost_before) else None
            if trial is not None:
                trial.add(block)
            elif log.damage:
                log.damage[-1].left_out += len(block)
        elif frame.tag in (wal.MARK, wal.END):
            value = frame.json
            trial = trial if trial is not None and trial.reaches(int(value["seq"])) else None
            if trial is not None and frame.tag == wal.MARK:
                trial.marks.append(value)
            elif trial is not None:
                trial.end, trial = value, None
            elif frame.tag == wal.END and log.trials and value.get("trial") == log.trials[-1].name:
                log.trials[-1].end = {**(log.trials[-1].end or {}), **value}  # a fault that showed after the end
    if not log.header:
        raise UserError(f"{name}: the log ends within its first frame, before any sample was recorded.")
    return log


def _finger(values: dict[str, Any]) -> FingerDescription:
    arrays = {"active": bool, "crosses": bool}
    names = ("joint_names", "tendon_names", "prismatic")
    fields: dict[str, Any] = {
        key: tuple(value) if key in names else None if value is None else np.array(value, arrays.get(key, float))
        for key, value in values.items()
    }
    return FingerDescription(**fields)


@dataclass(frozen=True)
class Samples:
    """The samples of one trial, each once.

    `seq` (N,) numbers them, `time` (N,) is in s from the first, `x` (N, C) in SI. Those marked in `kept` (N,) make the
    trial; the others came after its end, are not finite in some channel, or are flagged by their terminal.
    `clock_jumps` counts the samples at which the device's clock did not increase.
    """

    seq: np.ndarray
    time: np.ndarray
    x: np.ndarray
    kept: np.ndarray
    gaps: list[tuple[int, int]]  # (first seq after the gap, samples lost)
    clock_jumps: int


def _samples(logged: LoggedTrial, width: int, rate_hz: float) -> Samples:
    """Join the blocks of a trial, drop repeated samples, find gaps, and mend times at which the clock ran back."""
    blocks = logged.blocks
    empty = np.empty(0, np.int64)
    seq = np.concatenate([empty, *(b.seq.astype(np.int64) for b in blocks)])
    t = np.concatenate([empty, *(b.t_ns.astype(np.int64) for b in blocks)])
    x = np.concatenate([np.empty((0, width)), *(b.x for b in blocks)])
    flags = np.concatenate([empty, *(b.flags.astype(np.int64) for b in blocks)])
    fresh = seq > np.maximum.accumulate(np.concatenate([[-1], seq[:-1]])) if len(seq) else np.empty(0, bool)
    keep = fresh & (seq >= int(logged.start["seq"]))
    seq, t, x = seq[keep], t[keep], x[keep]
    sound = np.isfinite(x).all(1) & ((flags[keep] & FLAGGED) == 0)
    if not len(seq):
        return Samples(seq, seq * 1.0, x, keep[:0], [], 0)
    steps, jump = np.diff(t), np.diff(seq)
    nominal = np.round(jump * 1e9 / rate_hz).astype(np.int64)
    wrong = steps <= 0
    if wrong.any():  # Where the clock ran back, the count of samples gives the time that passed.
        steps = np.where(wrong, nominal, steps)
    time = np.concatenate([[0], np.cumsum(steps)]) * 1e-9
    gaps = [(int(seq[i + 1]), int(jump[i] - 1)) for i in np.flatnonzero(jump > 1)]
    end = logged.end or {}
    last = int(end.get("seq", seq[-1] + 1))
    return Samples(seq, time, x, (seq < last) & sound, gaps, int(wrong.sum()))


def _trial(logged: LoggedTrial, samples: Samples, head: dict[str, Any], finger: FingerDescription) -> Trial:
    """Make the trial of the dataset format. Channels that mean nothing in this trial are left out or NaN."""
    start, keep = logged.start, samples.kept
    seq, x, count = samples.seq[keep], samples.x[keep], int(keep.sum())
    where = {(c["kind"], c["of"]): i for i, c in enumerate(head["channels"])}
    tare = np.array([start["tare"].get(c["name"], 0.0) for c in head["channels"]])
    x = x - tare

    def columns(kind: str, names: Iterable[str]) -> np.ndarray | None:
        places = [where.get((kind, name)) for name in names]
        if all(p is None for p in places):
            return None
        return np.stack([x[:, p] if p is not None else np.full(count, np.nan) for p in places], 1)

    q = columns("joint_position", finger.joint_names)
    assert q is not None
    excursion = torque = None
    if start["loaded"]:
        excursion = columns("excursion", finger.tendon_names)
        if excursion is not None:
            excursion[:, [name not in start["loaded"] for name in finger.tendon_names]] = np.nan
    if start["motor"] and (sensor := where.get(("external_torque", ""))) is not None:
        torque = np.full((count, finger.m), np.nan)
        torque[:, finger.joint_names.index(start["motor"])] = x[:, sensor]
    time = samples.time[keep]
    hold, joint_direction, tendon_direction = _marked(logged.marks, seq, finger)
    return Trial(
        name=start["name"],
        experiment=start["experiment"],
        time=time - time[0],
        q=q,
        tendon_force=columns("tension", finger.tendon_names),
        tendon_excursion=excursion,
        joint_torque=torque,
        fingertip_force=columns("fingertip_force", "xyz") if start["contact"] else None,
        joint_direction=joint_direction,
        tendon_direction=tendon_direction,
        hold=hold,
        joint=start["joint"],
        tendon=start["tendon"],
        complete=logged.complete,
        motion=start["motion"],
        session_start=start["session_start"],
    )


def _marked(marks: list[dict[str, Any]], seq: np.ndarray, finger: FingerDescription):
    """Return hold (N,), joint directions (N, m) and tendon directions (N, n). A mark holds until the next one."""
    if not marks:
        return None, None, None
    hold = np.full(len(seq), -1, np.int32)
    joint, tendon = np.zeros((len(seq), finger.m), np.int8), np.zeros((len(seq), finger.n), np.int8)
    for mark in marks:
        after = seq >= int(mark["seq"])
        hold[after] = mark["hold"]
        for values, names, directions in (
            (joint, finger.joint_names, mark["joint_direction"]),
            (tendon, finger.tendon_names, mark["tendon_direction"]),
        ):
            values[after] = [directions.get(name, 0) for name in names]
    held = hold if (hold >= 0).any() else None  # None: the trial was cut short before its first hold.
    return held, joint, tendon if any(m["tendon_direction"] for m in marks) else None


def publish(log: Log, output: str | Path, overwrite: bool = False) -> Session:
    """Write the session of a log: the whole file or none. Trials with fewer than two good samples are left out.

    Raises:
        UserError: the file exists and is not to be overwritten, or cannot be written.
    """
    finger = _finger(log.header["finger"])
    trials, extras = {}, {}
    for logged in log.trials:
        samples = _samples(logged, len(log.header["channels"]), float(log.header["rate_hz"]))
        if samples.kept.sum() >= 2:
            trials[logged.name] = _trial(logged, samples, log.header, finger)
            extras[logged.name] = (logged, samples)
    session = Session(
        specimen=log.header["specimen"], finger=finger, trials=trials, source=log.header["source"],
        created=log.header["created"],
    )  # fmt: skip
    with new_file(output, overwrite) as file:
        write_into(file, session)
        for name, (logged, samples) in extras.items():
            _write_trial_attributes(file.require_group(f"trials/{name}").attrs, logged, samples)
        _write_rig_group(file.create_group("rig"), log, extras)
    return session


def _write_trial_attributes(attributes: h5py.AttributeManager, logged: LoggedTrial, samples: Samples) -> None:
    """Write the attributes that only a recording on the rig has."""
    attributes["parameters"] = json.dumps(logged.start["parameters"])
    attributes["lost_samples"] = sum(lost for _, lost in samples.gaps)
    if samples.clock_jumps:
        attributes["clock_jumps"] = samples.clock_jumps
    last = int((logged.end or {}).get("seq", 2**62))
    if broken := int((~samples.kept & (samples.seq < last)).sum()):
        attributes["dropped_samples"] = broken  # Not finite, or flagged; /rig/dropped holds them.
    if clocks := (logged.end or {}).get("clocks"):
        attributes["host_minus_device_s"], attributes["device_time_s"] = np.array(clocks) * 1e-9
    if not logged.complete:
        attributes["cause"] = logged.cause
        attributes["trip"] = int((logged.end or {}).get("trip", 0))


def _write_rig_group(group: h5py.Group, log: Log, extras: dict[str, tuple[LoggedTrial, Samples]]) -> None:
    """Write `/rig`, which readers of the format ignore: how the session was recorded, and what no trial holds."""
    text = h5py.string_dtype("utf-8")
    group.attrs["rig_file"], group.attrs["plan_file"] = log.header["rig"], log.header["plan"]
    group.attrs["fingerprint"] = json.dumps(log.header["fingerprint"])
    group.create_dataset("events", data=[json.dumps(e) for e in log.events] or np.empty(0, object), dtype=text)
    filters = group.create_group("filters")
    names = list(log.header["filters"])
    rows = [log.header["filters"][n] for n in names]
    filters.create_dataset("channel", data=names or np.empty(0, object), dtype=text)
    filters.create_dataset("enabled", data=np.array([r["enabled"] for r in rows], bool))
    filters.create_dataset("setting", data=np.array([r["setting"] for r in rows], np.int64))
    bandwidth = filters.create_dataset("bandwidth", data=np.array([r["bandwidth"] or np.nan for r in rows], float))
    bandwidth.attrs["units"] = "Hz"
    gaps = [(name, first, lost) for name, (_, samples) in extras.items() for first, lost in samples.gaps]
    table = group.create_group("gaps")
    table.create_dataset("trial", data=[g[0] for g in gaps] or np.empty(0, object), dtype=text)
    table.create_dataset("seq", data=np.array([g[1] for g in gaps], np.int64))
    table.create_dataset("lost", data=np.array([g[2] for g in gaps], np.int64))
    if log.damage:
        table = group.create_group("damage")  # bytes of the log that could not be read
        table.create_dataset("trial", data=[d.trial for d in log.damage], dtype=text)
        for key in ("at", "size", "lost", "left_out"):
            table.create_dataset(key, data=np.array([getattr(d, key) for d in log.damage], np.int64))
    watched = group.create_group("watched")  # channels of SAFETY_KINDS, sample for sample beside the trial
    for i, channel in enumerate(log.header["channels"]):
        if channel["kind"] in SAFETY_KINDS:
            for name, (_, samples) in extras.items():
                place = watched.create_dataset(f"{name}/{channel['name']}", data=samples.x[samples.kept, i])
                place.attrs["units"] = SI_UNITS[channel["kind"]]
    dropped = group.create_group("dropped")  # samples after a trip, or not finite in some channel
    dropped.create_dataset("channel", data=[c["name"] for c in log.header["channels"]], dtype=text)
    for name, (_, samples) in extras.items():
        if not samples.kept.all():
            rest = dropped.create_group(name)
            rest.create_dataset("seq", data=samples.seq[~samples.kept])
            rest.create_dataset("time", data=samples.time[~samples.kept]).attrs["units"] = "s"
            rest.create_dataset("value", data=samples.x[~samples.kept])
