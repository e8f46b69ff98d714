"""A simulated finger in this process: the controller's program runs as fast as its samples are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from jaxfinger.data.toml import Within
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.ring import RingRig
from jaxfinger.rig.simulated.controller import Controller

BEAT_CYCLES = 50  # cycles of 1 ms between two heartbeats, as `watch.BEAT_S` in real time


@dataclass(frozen=True)
class Address:
    """Keys of `[address]`: `seed` of the sensors' noise; `filtered = 1` for terminals with their factory filter on."""

    seed: Annotated[int, Within(0)] = 0
    filtered: Annotated[int, Within(0, 1)] = 0


class SimulatedRig(RingRig):
    """A simulated rig. Its samples are computed when they are read, so a session repeats exactly."""

    synchronous = True
    simulated_time = True

    def __init__(self, description: RigDescription, controller: Controller | None = None):
        super().__init__(description)
        seed, filtered = int(description.address.get("seed", 0)), bool(description.address.get("filtered", 0))
        self.controller = controller or Controller(seed=seed, filtered=filtered)

    def _open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def _read(self, symbol: str, offset: int, size: int, urgent: bool = False) -> bytes:
        at = self.controller.place[symbol][0] + offset
        return bytes(self.controller.memory[at : at + size])

    def _write(self, symbol: str, data: bytes, mend: bool = True, urgent: bool = False) -> None:
        at = self.controller.place[symbol][0]
        self.controller.memory[at : at + len(data)] = data

    def _pause(self, seconds: float) -> None:
        """Run the controller for `seconds`, with heartbeats: the thread that makes time pass is alive."""
        for k in range(max(1, round(seconds * self.description.rate_hz))):
            if k % BEAT_CYCLES == 0:
                self.beat()
            self.controller.cycle()

    def _sizes(self) -> dict[str, int]:
        return {symbol: size for symbol, (_, size) in self.controller.place.items()}

    def _has_bench(self) -> bool:
        return True


def make(description: RigDescription) -> SimulatedRig:
    """Return the rig of a rig file."""
    return SimulatedRig(description)
