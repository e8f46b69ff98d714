"""A stand-in for the real controller: a simulated finger at 1 kHz behind real ADS on 127.0.0.1, in its own process.

    python -m jaxfinger.rig.standin --port 48898

It prints `listening 127.0.0.1:PORT` and runs until it is stopped.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from jaxfinger.rig import contract
from jaxfinger.rig.simulated.ams import AmsServer
from jaxfinger.rig.simulated.controller import Controller, HardLimits
from jaxfinger.rig.simulated.faults import AT_START, CATALOGUE, InjectedFault, parse

NET_ID = "127.0.0.1.1.1"
BURST = 100  # cycles in a row before ADS requests get the memory


def serve(controller: Controller, speed: float, port: int, stop: threading.Event, say: Callable[[str], None]) -> None:
    """Run the controller at `speed` times real time until `stop`. A slow machine stretches time and loses no sample.

    At speed 0 time advances only as the host reads (`Lockstep`), so that no machine is too slow.
    """
    lock = threading.Lock()
    places = {contract.PREFIX + name: place for name, place in controller.place.items()}

    def delay() -> float:
        return controller.amount("delay") or 0.0

    def unanswered() -> str:
        return "" if controller.amount("mute") is None else f"{contract.PREFIX}aRing"

    server = AmsServer(controller.memory, places, lock, port, delay, unanswered)
    say(f"listening 127.0.0.1:{server.port}")
    pace = Lockstep(controller) if speed == 0 else RealTime(controller, speed)
    try:
        while not stop.is_set():
            count = pace.due()
            if count:
                with lock:
                    for _ in range(count):
                        controller.cycle()
            if controller.cut:
                controller.cut = False
                server.cut()
            if count < BURST:
                time.sleep(pace.rest)
    finally:
        server.close()


class RealTime:
    """Pace of the clock: as many cycles as are due, in bursts, so that requests are answered in between."""

    def __init__(self, controller: Controller, speed: float):
        self._controller, self._period = controller, contract.CYCLE_NS * 1e-9 / speed
        self._next = time.monotonic()
        self.rest = min(self._period, 1e-3)

    def due(self) -> int:
        """Number of cycles to run now."""
        period = self._period / (self._controller.amount("slow") or 1.0)
        behind = int((time.monotonic() - self._next) / period)
        count = min(behind, BURST)
        self._next += count * period
        if behind > 20 * BURST:  # More than 2 s behind: the machine stood still. Stretch time instead of catching up.
            self._next = time.monotonic()
        return count


class Lockstep:
    """Pace of the host: a burst of cycles for every heartbeat, and one cycle while a command waits."""

    rest = 1e-4

    def __init__(self, controller: Controller):
        self._controller, self._beat = controller, 0

    def due(self) -> int:
        """Number of cycles to run now."""
        memory, place = self._controller.memory, self._controller.place
        (beat,) = struct.unpack_from("<Q", memory, place["nHostBeat"][0])
        (command,) = struct.unpack_from("<I", memory, place["stCommand"][0])
        fresh, self._beat = beat != self._beat, beat
        return BURST if fresh else int(command != self._controller.acknowledged)


class StandIn:
    """A stand-in in another process: its address `where`, and access to it through its standard input and output."""

    def __init__(self, process: subprocess.Popen[str]):
        self._process = process
        word = self._line().split()
        if word[:1] != ["listening"]:
            raise RuntimeError("the stand-in did not start")
        self.where = word[1]
        self.pid = process.pid

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def _ask(self, line: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return json.loads(self._line())

    def report(self) -> dict[str, Any]:
        """Return `Controller.report`."""
        return self._ask("report")

    def strike(self, fault: str) -> dict[str, Any]:
        """Begin a fault, written as on the command line, at the next sample. Return the report."""
        return self._ask(f"fault {fault}")


@contextmanager
def started(
    speed: float = 1.0, heartbeat: float = 0.25, seed: int = 0, filtered: bool = False, faults: Sequence[str] = ()
) -> Iterator[StandIn]:
    """Start a stand-in in a process that ends with this one. `heartbeat` is its watchdog in s."""
    arguments = ["--speed", str(speed), "--heartbeat", str(heartbeat), "--seed", str(seed)]
    arguments += [word for fault in faults for word in ("--fault", fault)] + (["--filtered"] if filtered else [])
    command = [sys.executable, "-m", "jaxfinger.rig.standin", "--with-parent", *arguments]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        yield StandIn(process)
    finally:
        process.stdin.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


@contextmanager
def running(speed: float = 1.0, heartbeat: float = 0.25) -> Iterator[str]:
    """Start a stand-in as `started` does. Yield host:port, for `ip` in the rig file."""
    with started(speed, heartbeat) as bench:
        yield bench.where


def make(speed: float, heartbeat: float, seed: int, filtered: bool, faults: Sequence[InjectedFault]) -> Controller:
    """Return the controller that the command line asks for."""
    at_start = {fault.name: fault.amount for fault in faults if fault.name in AT_START}
    limits = HardLimits(heartbeat_s=at_start.get("watchdog", heartbeat * (speed or 1.0)))
    controller = Controller(limits=limits, seed=seed, filtered=filtered, lockstep=speed == 0)
    if "size" in at_start:
        controller.place["stCommand"] = controller.place["stCommand"][0], round(at_start["size"])
    if "ring" in at_start:
        controller.tell_ring(round(at_start["ring"]))
    for fault in faults:
        if fault.name not in AT_START:
            first = round(fault.after_s * 1e9 / contract.CYCLE_NS)
            controller.strike(fault.name, fault.slot, first, fault.amount, standing=True)
    return controller


def main() -> None:
    """Command line of the stand-in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=0, help="TCP port on 127.0.0.1 (0: any free one)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time; 0: as fast as the host reads")
    parser.add_argument(
        "--heartbeat", type=float, default=0.25, help="seconds of wall time without the host's beat before it stops"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the sensors' noise")
    parser.add_argument("--filtered", action="store_true", help="terminals at their factory filter of 22 Hz")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[:SLOT][=AMOUNT][@SECONDS]",
        help="; ".join(f"{name}: {fault.says}" for name, fault in (CATALOGUE | AT_START).items()),
    )
    parser.add_argument("--with-parent", action="store_true", help="obey lines on standard input; end when it closes")
    options = parser.parse_args()
    try:
        faults = [parse(text) for text in options.fault]
    except ValueError as error:
        parser.error(str(error))
    controller = make(options.speed, options.heartbeat, options.seed, options.filtered, faults)
    stop = threading.Event()

    def say(line: str) -> None:
        print(line, flush=True)

    def obey_parent() -> None:
        for line in sys.stdin:
            word, _, rest = line.strip().partition(" ")
            if word == "fault":
                fault = parse(rest)
                controller.strike(fault.name, fault.slot, controller.seq, fault.amount)
            say(json.dumps(controller.report()))
        stop.set()

    if options.with_parent:
        threading.Thread(target=obey_parent, daemon=True).start()
    with suppress(KeyboardInterrupt):
        serve(controller, options.speed, options.port, stop, say)
