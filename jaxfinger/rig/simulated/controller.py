"""The controller's program in Python, cycle by cycle: the contract's reference (`docs/plc-contract.md`).

The stand-in and the backend `simulated` both run it around the simulated finger: commands, ramps, hard limits,
heartbeat, release, and the ring of samples, in the memory layout of the contract. The thresholds of its limits are
written here and not imported from the host's code, on which a controller must not depend.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from jaxfinger.rig import contract
from jaxfinger.rig.contract import DRIVES_ON, Flag, Kind, Mode, Refusal, State, Trip
from jaxfinger.rig.simulated.faults import CATALOGUE
from jaxfinger.rig.simulated.plant import DT, Plant, Sensors

_SAMPLE = struct.Struct(f"<QQII{contract.VALUES}dQ")
_COMMAND = struct.Struct(f"<IIiIdd{contract.TARGETS}d")
_STATUS = struct.Struct("<QQIIQdiIII")
TEMPERATURE = 30.0  # °C of the simulated motors, which stay cool
_EPOCH_NS = 820_000_000 * 1_000_000_000  # ns since 2000-01-01 at the start: the simulated clock begins in 2025
FULL_COUNT, LEAK = 3, 0.25  # bad cycles that trip a limit, and what a good one takes off (contract, Trips)
# A tendon with a set-point above LOADED N that reads less than SLACK N is slack or broken (contract, trip 3).
LOADED, SLACK = 1.5, 0.2
# Release (contract): all tendons in proportion until the highest is at most so many N, each ramp within so many s.
RELEASE_RAMPS = ((2.0, 0.2), (0.5, 0.5))
RELEASED = RELEASE_RAMPS[-1][0]  # N; with less on every tendon the external motor need not hold its joint
FORCE_LAG = 0.015  # s, time constant of the drives' force loop


@dataclass(frozen=True)
class HardLimits:
    """The controller's own limits: the fields of ST_Limits, SI. The numbers are proposals for tendons up to 15 N."""

    tension_max: float = 20.0  # N
    tension_rate_max: float = 500.0  # N/s
    joint_velocity_max: float = 10.5  # rad/s, 600 °/s
    joint_torque_max: float = 0.5  # N m
    fingertip_force_max: float = 20.0  # N
    heartbeat_s: float = 0.25  # s


class Slots:
    """Slots of the simulated rig's channels: first the `noisy` ones of sensors, then set-points and temperatures."""

    def __init__(self, n: int, m: int):
        self.tension = list(range(n))
        self.excursion = list(range(n, 2 * n))
        self.angle = list(range(2 * n, 2 * n + m))
        self.torque = 2 * n + m
        self.force = list(range(2 * n + m + 1, 2 * n + m + 4))
        self.noisy = 2 * n + m + 4
        self.setpoint = list(range(self.noisy, self.noisy + n))
        self.temperature = list(range(self.noisy + n, self.noisy + 2 * n))


class Controller:
    """The program; `cycle()` runs one cycle of 1 ms. `memory` holds the symbols, as ADS serves them.

    With `filtered` the terminals have their factory filter on. `lockstep` tells the host that time advances only as it
    reads.
    """

    def __init__(
        self,
        plant: Plant | None = None,
        limits: HardLimits | None = None,
        seed: int = 0,
        ring: int = contract.RING,
        sensors: Sensors | None = None,
        filtered: bool = False,
        lockstep: bool = False,
    ):
        self.plant = plant or Plant()
        self.limits = limits or HardLimits()
        self.sensors = sensors or Sensors()
        self.slots = Slots(self.plant.n, self.plant.m)
        self._stops = self.plant.truth.finger.limits.tolist()
        self.ring = ring
        self.place = contract.layout(ring)
        self.memory = bytearray(sum(self.place["stBench"]))
        self.faults: dict[str, tuple[int, int, float]] = {}  # kind: (slot, first sample, amount)
        self.standing: dict[str, tuple[int, int, float]] = {}  # faults that preparing the finger does not mend
        self.filtered, self.lockstep = filtered, lockstep
        self.struck: int | None = None  # number of the sample at which a fault first showed
        self.cut = False  # asks the server to close its connections
        self.rng = np.random.default_rng(seed)
        self.boot = 0
        self.start()

    def start(self) -> None:
        """Start the program: counters at zero, a new boot number, everything off."""
        n = self.plant.n
        self.boot += 1
        self.seq = 0
        self.state = State.IDLE
        self._code = int(self.state)  # state as written to the sample, which a fault may change
        self.trip, self.trip_seq, self.trip_value, self.trip_slot = Trip.NONE, 0, 0.0, -1
        self.acknowledged, self.refused = 0, Refusal.NONE
        self.target, self.setpoint, self.tension = [0.0] * n, [0.0] * n, [0.0] * n
        self.rate = 10.0
        # Angle (rad), velocity and acceleration of the external motor; None: no torque, or no joint coupled.
        self.motor: tuple[float, float, float] | None = None
        self.goal, self.speed, self.acceleration = 0.0, 0.5, 20.0
        self.beat, self.beat_age = 0, 0  # last heartbeat, and cycles since it changed
        self.ramps: list[tuple[float, float]] = []  # ramps left of a release: (share of the start's tensions, s)
        self.bench = 0
        self.over: dict[tuple[Trip, int], float] = {}  # leaky count by limit and slot
        self.memory[:] = bytes(len(self.memory))
        info = np.zeros((), contract.INFO)
        info["version"], info["sample_size"], info["ring_length"] = (
            contract.VERSION,
            contract.SAMPLE.itemsize,
            self.ring,
        )
        info["values"], info["cycle_ns"], info["boot"] = contract.VALUES, contract.CYCLE_NS, self.boot
        info["program"] = b"jaxfinger stand-in"
        self._put("stInfo", info.tobytes())
        limits = self.limits
        self._put("stLimits", struct.pack("<6d", *(getattr(limits, name) for name in contract.LIMITS.names or ())))
        filters = np.zeros(contract.VALUES, contract.FILTER)
        if self.filtered:  # Factory setting of an EL3008: 50 Hz FIR, −3 dB at 22 Hz.
            filters["enabled"][[*self.slots.tension, self.slots.torque, *self.slots.force]] = 1
            filters["bandwidth"][filters["enabled"] == 1] = 22.0
        self._put("aFilter", filters.tobytes())
        bench = np.zeros((), contract.BENCH)
        bench["lockstep"] = self.lockstep
        self._put("stBench", bench.tobytes())
        self.off = 0  # number of the sample since which every set-point is zero; −1: one is not
        self._frozen_t, self._struck_t = 0, 0
        self._noise = self.rng.standard_normal((4096, self.slots.noisy))
        self._values = self._before = [0.0] * contract.VALUES
        self._status()

    def tell_ring(self, length: int) -> None:
        """State a wrong length of the ring in stInfo."""
        self.place["aRing"] = self.place["aRing"][0], length * contract.SAMPLE.itemsize
        at = self.place["stInfo"][0] + contract.INFO.fields["ring_length"][1]  # type: ignore[index]
        struct.pack_into("<I", self.memory, at, length)

    def _put(self, symbol: str, data: bytes) -> None:
        offset, size = self.place[symbol]
        assert len(data) == size
        self.memory[offset : offset + size] = data

    # one cycle --------------------------------------------------------------------------------------------------
    def cycle(self) -> None:
        """Read the command, advance ramps and finger by 1 ms, measure, check, write the sample."""
        self._bench()
        fault = {kind: (slot, amount) for kind, (slot, first, amount) in self.faults.items() if self.seq >= first}
        if fault and self.struck is None:
            self.struck, self._struck_t = self.seq, self._time({})
        if "restart" in fault:
            self.faults.clear()
            self.start()
        if "cut" in fault:
            self.cut = True
            del self.faults["cut"]
        if "stall" in fault:
            return
        self._couple()
        self._commands("deaf" in fault)
        self._heartbeat()
        self._ramps()
        self.plant.step(self.tension, self.motor)
        flags = self._measure(fault)
        self._check(flags)
        self.off = -1 if any(self.setpoint) else self.seq if self.off < 0 else self.off
        self._sample(flags, fault)

    def strike(
        self, kind: str, slot: int = 0, first: int = 0, amount: float = math.nan, standing: bool = False
    ) -> None:
        """Begin a fault of `faults.CATALOGUE` at sample `first`.

        It lasts until the finger is prepared, or for ever where it is `standing`. Without `amount` it has its default.
        """
        self.struck = None
        self.faults[kind] = slot, first, CATALOGUE[kind].amount if math.isnan(amount) else amount
        if standing:
            self.standing[kind] = self.faults[kind]

    def amount(self, kind: str) -> float | None:
        """Amount of a fault that is active, or None. The server asks this for faults outside of the program."""
        _, first, amount = self.faults.get(kind, (0, math.inf, 0.0))
        return amount if self.seq >= first else None

    def report(self) -> dict[str, int | None]:
        """Return the state, and the numbers of the samples where the fault showed, it tripped, and tension was off."""
        return {"head": self.seq, "state": int(self.state), "trip": int(self.trip), "boot": self.boot,
                "trip_seq": self.trip_seq, "fault_seq": self.struck, "off_seq": self.off}  # fmt: skip

    def _couple(self) -> None:
        """Have the external motor hold the joint to which it is coupled, once the drives are on."""
        if Mode.MOTOR not in self.plant.mode:
            self.motor = None
        elif self.motor is None and self.state in DRIVES_ON:
            self.goal = self.plant.q[self.plant.mode.index(Mode.MOTOR)]
            self.motor = (self.goal, 0.0, 0.0)

    def _commands(self, deaf: bool) -> None:
        """Process a new command. A `deaf` controller acknowledges STOP and RELEASE without obeying."""
        offset, _ = self.place["stCommand"]
        number, kind, index, _, rate, acceleration, *target = _COMMAND.unpack_from(self.memory, offset)
        if number == self.acknowledged:
            return
        self.acknowledged = number
        ignored = deaf and kind in (Kind.STOP, Kind.RELEASE)
        self.refused = Refusal.NONE if ignored else self._obey(kind, index, rate, acceleration, target)

    def _obey(self, kind: int, index: int, rate: float, acceleration: float, target: list[float]) -> Refusal:
        """Carry out a command, or refuse it. STOP is obeyed in every state."""
        on = self.state in DRIVES_ON
        if kind == Kind.STOP:
            self._stop(Trip(index), -1, 0.0)
        elif kind == Kind.RESET:
            if self.state is not State.TRIPPED or self.ramps:
                return Refusal.STATE
            self.state, self.trip, self.trip_slot = State.IDLE, Trip.NONE, -1
        elif kind == Kind.ARM:
            if self.state is not State.IDLE:
                return Refusal.STATE
            self.state, self.beat_age, self.motor = State.ARMED, 0, None  # `_couple` takes the motor's angle.
            self.setpoint, self.target = [0.0] * self.plant.n, [0.0] * self.plant.n
        elif kind == Kind.DISARM:
            if not on and self.state is not State.IDLE:
                return Refusal.STATE
            self.state, self.motor = State.IDLE, None
            self.setpoint, self.target = [0.0] * self.plant.n, [0.0] * self.plant.n
        elif kind == Kind.RELEASE:
            if on:
                self._release()
        elif kind in (Kind.TENSION, Kind.JOINT, Kind.HOLD):
            if not on:
                return Refusal.STATE
            return self._set(kind, rate, acceleration, target)
        else:
            return Refusal.KIND
        return Refusal.NONE

    def _set(self, kind: int, rate: float, acceleration: float, target: list[float]) -> Refusal:
        """Set the goals of TENSION, JOINT or HOLD, or refuse those beyond the hard limits."""
        limits, n = self.limits, self.plant.n
        if kind == Kind.HOLD:
            self.target = self.setpoint[:]
            self._brake()
            return Refusal.NONE
        if not 0 < rate < math.inf:
            return Refusal.RANGE
        if kind == Kind.TENSION:
            wanted = [new if not math.isnan(new) else old for new, old in zip(target[:n], self.target, strict=True)]
            if rate > limits.tension_rate_max or not all(0 <= w <= limits.tension_max for w in wanted):
                return Refusal.RANGE
            self.target, self.rate = wanted, rate
        else:
            if Mode.MOTOR not in self.plant.mode:
                return Refusal.STATE
            low, high = self.plant.truth.finger.limits[self.plant.mode.index(Mode.MOTOR)]
            if rate > limits.joint_velocity_max or not low <= target[0] <= high or not 0 < acceleration < math.inf:
                return Refusal.RANGE
            self.goal, self.speed, self.acceleration = target[0], rate, acceleration
        self.state = State.MOVING
        return Refusal.NONE

    def _heartbeat(self) -> None:
        """Stop where the host's heartbeat has not changed for `heartbeat_s` while the drives are on."""
        offset, _ = self.place["nHostBeat"]
        (beat,) = struct.unpack_from("<Q", self.memory, offset)
        self.beat_age = 0 if beat != self.beat else self.beat_age + 1
        self.beat = beat
        if self.state in DRIVES_ON and self.beat_age * DT > self.limits.heartbeat_s:
            self._stop(Trip.HEARTBEAT, -1, self.beat_age * DT)

    def _brake(self) -> None:
        """Let the external motor come to rest as soon as its acceleration allows."""
        if self.motor is not None:
            angle, velocity, _ = self.motor
            self.goal = angle + math.copysign(velocity**2 / (2 * self.acceleration), velocity)

    def _release(self) -> None:
        """Begin a release: the tendons begin RELEASE_RAMPS.

        The external motor brakes and holds its joint to their end: tendons would throw a joint that is let go before.
        Where no tendon pulls, it loses its torque at once, since a hand may be caught.
        """
        self.state = State.RELEASING
        self._brake()
        if max(self.setpoint) <= RELEASED:
            self.motor = None
        peak = max([*self.setpoint, 1e-9])
        self.ramps = [(min(tension / peak, 1.0), seconds) for tension, seconds in RELEASE_RAMPS]
        self._from, self._ramp_time = self.setpoint[:], 0.0

    def _stop(self, trip: Trip, slot: int, value: float) -> None:
        """Release and latch TRIPPED. The first cause stays."""
        if self.state is State.TRIPPED:
            return
        self.trip, self.trip_seq, self.trip_slot, self.trip_value = trip, self.seq, slot, value
        if self.state in DRIVES_ON:
            self._release()
        if trip in (Trip.TENSION, Trip.SLACK):  # Over-tension or a broken tendon: their drives go off without a ramp.
            self._from = self.setpoint = [0.0] * self.plant.n
        self.target, self.state = self.setpoint[:], State.TRIPPED

    def _ramps(self) -> None:
        """Advance the release, or tensions and motor toward their goals. Tensions follow with the drives' lag."""
        if self.ramps:
            self._advance_release()
        elif self.state is State.MOVING:
            step = self.rate * DT
            self.setpoint = [s + min(max(t - s, -step), step) for s, t in zip(self.setpoint, self.target, strict=True)]
            if self.setpoint == self.target and not self._move():
                self.state = State.ARMED
        elif Mode.MOTOR in self.plant.mode and self.motor is not None:
            self.motor = (self.motor[0], 0.0, 0.0)
        lag = DT / (DT + FORCE_LAG)
        self.tension = [f + lag * (s - f) for f, s in zip(self.tension, self.setpoint, strict=True)]

    def _advance_release(self) -> None:
        """Advance RELEASE_RAMPS by a cycle: all tendons in proportion. With the last one the drives go off."""
        share, seconds = self.ramps[0]
        self._ramp_time += DT
        part = min(self._ramp_time / seconds, 1.0)
        self.setpoint = [tension * (1.0 + (share - 1.0) * part) for tension in self._from]
        if part == 1.0:
            self.ramps.pop(0)
            if self.ramps:
                peak = max([*self.setpoint, 1e-9])
                self._from, self._ramp_time = self.setpoint[:], 0.0
                self.ramps[0] = (min(RELEASED / peak, 1.0), self.ramps[0][1])
            else:
                self.setpoint = [0.0] * self.plant.n
        self.target = self.setpoint[:]
        self._move()
        if not self.ramps:
            self.motor = None
            self.state = State.IDLE if self.state is State.RELEASING else self.state

    def _move(self) -> bool:
        """Advance the external motor on a trapezoidal velocity profile. Return False when it is at its goal."""
        if self.motor is None:
            return False
        angle, velocity, _ = self.motor
        distance = self.goal - angle
        # Braking in whole cycles from a velocity v covers v²/(2a) + v DT/2. `allowed` is the v that reaches the goal.
        brake = self.acceleration * DT / 2
        allowed = min(self.speed, math.sqrt(brake**2 + 2 * self.acceleration * abs(distance)) - brake)
        change = math.copysign(allowed, distance) - velocity
        change = min(max(change, -self.acceleration * DT), self.acceleration * DT)
        velocity += change
        if abs(distance) <= abs(velocity) * DT + 1e-6:  # Never past the goal: friction keeps the direction of approach.
            self.motor = (self.goal, 0.0, 0.0)
            return False
        self.motor = (angle + velocity * DT, velocity, change / DT)
        return True

    # measuring --------------------------------------------------------------------------------------------------
    def _measure(self, fault: dict[str, tuple[int, float]]) -> int:
        """Fill the values of this cycle's sample, with noise and faults. Return its flags."""
        plant, s, slots = self.plant, self.sensors, self.slots
        noise = self._noise[self.seq % 4096].tolist()
        fresh = self._values[:]
        for i, slot in enumerate(slots.tension):
            fresh[slot] = self.tension[i] + s.tension_noise * noise[slot]
        for slot, length in zip(slots.excursion, plant.excursion(), strict=True):
            fresh[slot] = length + s.excursion_noise * noise[slot]
        for j, slot in enumerate(slots.angle):
            fresh[slot] = round((plant.q[j] + s.angle_noise * noise[slot]) / s.angle_step) * s.angle_step
        fresh[slots.torque] = plant.external_torque + s.torque_offset + s.torque_noise * noise[slots.torque]
        for axis, slot in enumerate(slots.force):
            fresh[slot] = plant.tip_force[axis] + s.force_offset[axis] + s.force_noise * noise[slot]
        fresh[slots.setpoint[0] : slots.setpoint[-1] + 1] = self.setpoint
        fresh[slots.temperature[0] : slots.temperature[-1] + 1] = [TEMPERATURE] * plant.n
        flags = 0
        for kind, (slot, amount) in fault.items():
            if kind == "nan" or (kind == "flicker" and self.seq % 3):
                fresh[slot] = math.nan
            elif kind == "freeze":
                fresh[slot] = self._values[slot]
            elif kind == "spike":
                fresh[slot] += amount
            elif kind == "flag":
                flags |= Flag.ANALOG
        self._before, self._values = self._values, fresh
        return flags

    def _check(self, flags: int) -> None:
        """Stop where a hard limit's leaky count is full. One odd sample must not drop the finger; a value that is bad
        every other time must.
        """
        if self.state not in DRIVES_ON:
            self.over.clear()
            return
        limits, slots, values = self.limits, self.slots, self._values
        found: list[tuple[Trip, int, float]] = []
        if flags or not all(map(math.isfinite, values)):
            slot = next((i for i, v in enumerate(values) if not math.isfinite(v)), -1)
            found.append((Trip.INVALID, slot, math.nan))
        found += [
            (Trip.TENSION_RATE, i, (values[i] - self._before[i]) / DT)
            for i in slots.tension
            if abs(values[i] - self._before[i]) > limits.tension_rate_max * DT
        ]
        found += [(Trip.TENSION, i, values[i]) for i in slots.tension if values[i] > limits.tension_max]
        found += [
            (Trip.SLACK, i, values[i])
            for i, wanted in zip(slots.tension, self.setpoint, strict=True)
            if wanted > LOADED and values[i] < SLACK
        ]
        found += [
            (Trip.POSITION, slot, values[slot])
            for slot, (low, high) in zip(slots.angle, self._stops, strict=True)
            if not low <= values[slot] <= high
        ]
        found += [
            (Trip.VELOCITY, slot, velocity)
            for slot, velocity in zip(slots.angle, self.plant.qd, strict=True)
            if abs(velocity) > limits.joint_velocity_max
        ]
        if abs(values[slots.torque]) > limits.joint_torque_max:
            found.append((Trip.TORQUE, slots.torque, values[slots.torque]))
        found += [(Trip.FORCE, i, values[i]) for i in slots.force if abs(values[i]) > limits.fingertip_force_max]
        bad = {(trip, slot) for trip, slot, _ in found}
        # Every count leaks; a bad cycle gives that back and adds 1.
        self.over = {key: level - LEAK for key, level in self.over.items() if level > LEAK or key in bad}
        self.over |= {key: self.over.get(key, -LEAK) + LEAK + 1 for key in bad}
        for trip, slot, value in found:
            if self.over[trip, slot] >= FULL_COUNT:
                self._stop(trip, slot, value)
                return

    def _time(self, fault: dict[str, tuple[int, float]]) -> int:
        """Device's time in ns, with its faults."""
        t = _EPOCH_NS + self.seq * contract.CYCLE_NS
        if "clock-frozen" in fault:
            return self._struck_t
        if "clock-rate" in fault:
            t = self._struck_t + round((t - self._struck_t) * fault["clock-rate"][1])
        t += round(fault.get("clock-jump", (0, 0.0))[1] * 1e9)
        return t - round(fault.get("clock-back", (0, 0.0))[1] * 1e9)

    def _sample(self, flags: int, fault: dict[str, tuple[int, float]]) -> None:
        """Write this cycle's sample into the ring, then the status with the new head."""
        offset, _ = self.place["aRing"]
        at = offset + (self.seq % self.ring) * _SAMPLE.size
        self._code = round(fault["state"][1]) if "state" in fault else int(self.state)
        flags |= (self.acknowledged & 0xFFFF) << 16
        _SAMPLE.pack_into(self.memory, at, self.seq, self._time(fault), self._code, flags, *self._values, self.seq)
        self.seq += 1
        self._status()

    def _status(self) -> None:
        offset, _ = self.place["stStatus"]
        _STATUS.pack_into(
            self.memory, offset, self.seq, self.boot, self._code, self.trip, self.trip_seq, self.trip_value,
            self.trip_slot, self.acknowledged, self.refused, 0,
        )  # fmt: skip

    def _bench(self) -> None:
        """Obey a new order to the simulated operator: prepare the finger, or inject a fault."""
        offset, size = self.place["stBench"]
        (number,) = struct.unpack_from("<I", self.memory, offset)
        if number == self.bench:
            return
        order = np.frombuffer(self.memory[offset : offset + size], contract.BENCH)[0]
        self.bench = number
        if kind := int(order["fault"]):
            where = int(order["fault_slot"]), int(order["fault_seq"]), float(order["amount"])
            self.strike(contract.FAULTS[kind], *where)
            return
        m = self.plant.m
        self.faults = dict(self.standing)  # Preparing the finger mends the others.
        self.plant.prepare([Mode(v) for v in order["mode"][:m]], order["pose"][:m].tolist(), bool(order["contact"]))
        self.motor = None
