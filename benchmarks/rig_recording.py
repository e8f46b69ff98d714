"""Figures of `jaxfinger record`: samples lost at full rate, sessions after a killed recorder, cost of the stand-in.

    python benchmarks/rig_recording.py stream --minutes 10    1 kHz x 60 channels over ADS beside a busy interpreter
    python benchmarks/rig_recording.py kill --count 200       kill -9 at random moments; every session must be readable
    python benchmarks/rig_recording.py plant                  cost of one cycle of the stand-in

Prints one JSON object, which includes the load of the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.data import check_file, read_session
from jaxfinger.rig import parse_rig, recover, wal
from jaxfinger.rig.backends.ads import AdsRig
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.contract import VALUES, Mode
from jaxfinger.rig.convert import header
from jaxfinger.rig.operator import Nobody
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.session import log_path
from jaxfinger.rig.signals import Interrupts
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.controller import Controller
from jaxfinger.rig.simulated.examples import rig_toml
from jaxfinger.rig.watch import Watch

# Time limits, s, that a busy machine does not exceed: the measurement loads it on purpose.
SLOW: dict[str, Any] = {"stale_s": 5.0, "lag_s": 5.0, "thread_s": 5.0, "disk_s": 5.0, "clock_offset_s": 5.0}
PATIENT = "[controller]\nheartbeat_s = 5.0\n"


def all_slots(where: str, **rig) -> RigDescription:
    """Description of a rig with 60 channels: the finger's 15, and the slots that the stand-in leaves at zero."""
    description = parse_rig(rig_toml("ads", {"net_id": standin.NET_ID, "ip": where, "port": 851}, **rig) + PATIENT)
    used = {c.slot for c in description.channels}
    spare = [s for s in range(VALUES) if s not in used]
    first = description.channels[0]
    extra = tuple(replace_channel(first, name=f"spare {s}", slot=s) for s in spare)
    return replace_channel(description, channels=description.channels + extra)


def replace_channel(record, **changes):
    """Replace fields. Spare channels stay at zero, and are therefore not watched for being frozen."""
    from dataclasses import replace

    return replace(record, **({"frozen": 0.0} if "slot" in changes else {}), **changes)


def stream(minutes: float, busy: bool) -> dict:
    """Record for `minutes` and count lost samples. Latency is the time from a sample to its arrival in Python."""
    samples = round(minutes * 60_000)
    with standin.running(speed=1.0, heartbeat=5.0) as where, tempfile.TemporaryDirectory() as folder:
        description = all_slots(where, **SLOW)
        stop, spun = threading.Event(), []

        def spin() -> None:
            while not stop.is_set():
                sum(range(2000))
            spun.append(time.thread_time())

        with AdsRig(description) as rig:
            recorder = Recorder(
                Path(folder) / "s.wal", {**header(description, "", rig.filters(), rig.fingerprint()), "created": ""}
            )
            reader = Reader(rig, recorder, Supervisor(description))
            watch = Watch(rig, reader, Nobody(), Interrupts())
            start = {"name": "t", "tare": {}, "loaded": [], "motor": None, "contact": False}
            spinner = threading.Thread(target=spin, daemon=True)
            if busy:
                spinner.start()
            reader.begin(start)
            wall = time.monotonic()
            cpu_all = time.process_time()
            watch.start()
            reader.start(lambda: watch.join("reader"))
            arrivals = []
            while reader.samples < samples and reader.error is None:
                block = reader.next(1.0)
                if block is not None:
                    arrivals.append((time.monotonic_ns(), block.t_ns.astype(np.int64)))
            stop.set()
            if busy:
                spinner.join()
            watch.close()
            reader.close()
            wall, cpu = time.monotonic() - wall, time.process_time() - cpu_all - sum(spun)
            recorder.close()
        # On one machine both clocks run at the same rate.
        offsets = np.array([arrived - t[-1] for arrived, t in arrivals])
        ages = np.concatenate([arrived - t for arrived, t in arrivals]) - offsets.min()
        blocks = [f.block for f in wal.read_log(recorder.path) if f.tag == wal.DATA]
        seq = np.concatenate([b.seq for b in blocks]).astype(np.int64)
        return {
            "minutes": minutes,
            "channels": len(description.channels),
            "busy_interpreter": busy,
            "samples_in_log": len(seq),
            "lost": int(reader.lost) + int((np.diff(seq) - 1).sum()),
            "error": None if reader.error is None else str(reader.error),
            "latency_ms": {f"p{p}": round(float(np.percentile(ages, p)) / 1e6, 1) for p in (50, 99, 99.9, 100)},
            "poll_ms": description.poll_s * 1e3,
            "cores_used": round(cpu / wall, 3),  # all threads but the busy one
            "log_MB": round(recorder_size(blocks) / 1e6, 1),
            "load_average": os.getloadavg()[0],
        }


def recorder_size(blocks) -> int:
    """Size of the blocks in the log, bytes."""
    return sum(len(wal.pack_block(b)) for b in blocks)


PLAN = '[plan]\nname = "p"\noperator = "t"\n[[trial]]\nexperiment = "VD.1"\nseconds = 20000.0\n'
NURSERY = """
import os, signal, sys
from pathlib import Path
from jaxfinger.cli.record import record
import jaxfinger.rig.live, pyads
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
for line in sys.stdin:
    pid = os.fork()
    if pid == 0:
        plan, rig, output = map(Path, line.split())
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        record(plan, rig=rig, output=output, yes=True)
        os._exit(0)
    print(pid, flush=True)
"""


def kill(count: int, seed: int) -> dict:
    """Kill the recorder `count` times at random moments of a recording at real speed, and recover and check every log.

    `unsaved_ms`: samples, one a millisecond, that the controller had just after the kill and the log had not.
    """
    rng = random.Random(seed)
    unreadable, unsaved, torn = 0, [], 0
    # One process imports everything and forks the recorders: 200 starts of Python would take most of the time.
    born = subprocess.Popen([sys.executable, "-c", NURSERY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with (
        standin.running(speed=1.0, heartbeat=3.0) as where,
        tempfile.TemporaryDirectory() as root,
        born as nursery,
    ):
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for k in range(count):
            folder = Path(root) / str(k)
            folder.mkdir()
            address = {"net_id": standin.NET_ID, "ip": where, "port": 851}
            (folder / "rig.toml").write_text(rig_toml("ads", address, **SLOW) + PATIENT)
            (folder / "plan.toml").write_text(PLAN)
            files = [str(folder / name) for name in ("plan.toml", "rig.toml", "session.h5")]
            nursery.stdin.write(" ".join(files) + "\n")
            nursery.stdin.flush()
            recorder = int(nursery.stdout.readline())
            path = log_path(folder / "session.h5")
            while not (path.exists() and path.stat().st_size > 15_000):
                if not Path(f"/proc/{recorder}").exists():
                    raise SystemExit("a recorder ended by itself; the machine is too busy for this measurement")
                time.sleep(0.005)
            time.sleep(rng.uniform(0.0, 1.5))
            os.kill(recorder, signal.SIGKILL)
            rig = AdsRig(parse_rig(rig_toml("ads", address) + PATIENT))
            with rig:
                head = rig.next_seq  # when it connected: before it waited whether another host is alive
            try:
                found = recover(path, folder / "rescued.h5")
                errors = [f for f in check_file(folder / "rescued.h5") if f.severity == "error"]
                trial = read_session(folder / "rescued.h5")["01-VD.1"]
                torn += found.torn_bytes > 0
                unreadable += bool(errors) or np.any(np.abs(np.diff(trial.time) - 1e-3) > 1e-9)
                last = max(int(f.block.seq[-1]) for f in wal.read_log(path) if f.tag == wal.DATA)
                unsaved.append(head - 1 - last)
            except Exception as error:
                unreadable += 1
                print(f"kill {k}: {error}", file=sys.stderr)
        nursery.stdin.close()
    return {
        "kills": count,
        "unreadable": int(unreadable),
        "ended_within_a_frame": int(torn),
        "unsaved_ms": {"median": float(np.median(unsaved)), "max": float(np.max(unsaved))},
        "load_average": os.getloadavg()[0],
    }


def plant() -> dict:
    """Processor time of one cycle of the stand-in, μs: controller, finger and sample."""
    found = {}
    for name, mode, contact in (
        ("fixed", (1, 1, 1), 0),
        ("motor", (2, 1, 1), 0),
        ("hand", (3, 3, 3), 0),
        ("free", (0, 0, 0), 0),
        ("contact", (1, 1, 1), 1),
    ):
        controller = Controller()
        controller.plant.prepare([Mode(m) for m in mode], [0.3, 0.3, 0.3], bool(contact))
        times = []
        for _ in range(20):
            start = time.process_time()
            for _ in range(200):
                controller.cycle()
            times.append((time.process_time() - start) / 200 * 1e6)
        found[name] = round(float(np.median(times)), 1)
    return {"microseconds_per_cycle": found}


def main() -> None:
    """Print the measurement that the command line chooses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("stream", "kill", "plant"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--idle", action="store_true", help="no busy interpreter beside the recorder")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.what == "stream":
        result = stream(options.minutes, not options.idle)
    elif options.what == "kill":
        result = kill(options.count, options.seed)
    else:
        result = plant()
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
