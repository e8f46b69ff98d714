"""A stand-in controller: the simulated finger at 1 kHz behind real ADS on 127.0.0.1, in a process of its own.

    python -m jaxfinger.rig.standin --port 48898

It prints `listening 127.0.0.1:PORT` and runs until it is stopped.
"""

from __future__ import annotations

import argparse
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from jaxfinger.rig import contract
from jaxfinger.rig.simulated.ams import AmsServer
from jaxfinger.rig.simulated.controller import Controller, HardLimits

NET_ID = "127.0.0.1.1.1"
BURST = 100  # cycles in a row before others get the memory


def serve(controller: Controller, speed: float, port: int, stop: threading.Event) -> None:
    """Run the controller at `speed` times real time until `stop`; a slow machine stretches time, it loses no sample.

    At speed 0 time goes as fast as the host reads: each heartbeat buys BURST cycles, so that no machine is too slow.
    """
    lock = threading.Lock()
    places = {contract.PREFIX + name: place for name, place in controller.place.items()}
    server = AmsServer(controller.memory, places, lock, port)
    print(f"listening 127.0.0.1:{server.port}", flush=True)
    pace = Lockstep(controller) if speed == 0 else RealTime(speed)
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
    """As many cycles as the clock says, in bursts, so that requests are answered in between."""

    def __init__(self, speed: float):
        self._period = contract.CYCLE_NS * 1e-9 / speed
        self._next = time.monotonic()
        self.rest = min(self._period, 1e-3)

    def due(self) -> int:
        """Cycles to run now."""
        behind = int((time.monotonic() - self._next) / self._period)
        count = min(behind, BURST)
        self._next += count * self._period
        if behind > 20 * BURST:  # the machine stood still: stretch time rather than race after it
            self._next = time.monotonic()
        return count


class Lockstep:
    """A burst for every heartbeat, and a cycle for every command that waits."""

    rest = 1e-4

    def __init__(self, controller: Controller):
        self._controller, self._beat = controller, 0

    def due(self) -> int:
        """Cycles to run now."""
        memory, place = self._controller.memory, self._controller.place
        (beat,) = struct.unpack_from("<Q", memory, place["nHostBeat"][0])
        (command,) = struct.unpack_from("<I", memory, place["stCommand"][0])
        fresh, self._beat = beat != self._beat, beat
        return BURST if fresh else int(command != self._controller.acknowledged)


@contextmanager
def running(speed: float = 1.0, heartbeat: float = 0.25, seed: int = 0, filtered: bool = False) -> Iterator[str]:
    """A stand-in in a process of its own; yields host:port for the rig file's `ip`."""
    arguments = ["--speed", str(speed), "--heartbeat", str(heartbeat), "--seed", str(seed)]
    command = [
        sys.executable,
        "-m",
        "jaxfinger.rig.standin",
        "--with-parent",
        *arguments,
        *(["--filtered"] if filtered else []),
    ]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        word = process.stdout.readline().split()
        if word[:1] != ["listening"]:
            raise RuntimeError("the stand-in did not start")
        yield word[1]
    finally:
        process.stdin.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


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
    parser.add_argument("--with-parent", action="store_true", help="end when standard input closes")
    options = parser.parse_args()
    limits = HardLimits(heartbeat_s=options.heartbeat * (options.speed or 1000.0))
    stop = threading.Event()

    def parent_is_gone() -> None:
        sys.stdin.read()
        stop.set()

    if options.with_parent:
        threading.Thread(target=parent_is_gone, daemon=True).start()
    with suppress(KeyboardInterrupt):
        serve(
            Controller(limits=limits, seed=options.seed, filtered=options.filtered), options.speed, options.port, stop
        )


if __name__ == "__main__":
    main()
