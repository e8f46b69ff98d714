"""Seconds and compiled programs of `jaxfinger diagnose`, with and without `--quick`, with an empty and a full cache.

    python benchmarks/diagnose.py [SESSION.h5 ...]      # default: the shipped session

Each of the two has its own cache, so that neither uses what the other has compiled.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jaxfinger.data import read_session

SHIPPED = Path(__file__).parents[1] / "datasets" / "paper-finger" / "session.h5"


def seconds(session: Path, folder: Path, *options: str) -> float:
    """Wall time of one `jaxfinger diagnose`."""
    command = [sys.executable, "-m", "jaxfinger", "diagnose", str(session), "-o", str(folder / "gap"), "--overwrite"]
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    begun = time.perf_counter()
    subprocess.run([*command, *options], check=True, capture_output=True, env=environment)
    return time.perf_counter() - begun


def verdict(folder: Path) -> str:
    """Verdict of the last diagnosis."""
    said = json.loads((folder / "gap" / "gap.json").read_text(encoding="utf-8"))["verdict"]
    return ", ".join([said["status"], *("-".join([e["effect"], *e["site"]]) for e in said["effects"])])


def main() -> None:
    """Print times of both, first with an empty cache, for every file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", nargs="*", type=Path, default=[SHIPPED])
    for path in parser.parse_args().sessions:
        session = read_session(path)
        minutes, samples = sum(t.duration for t in session) / 60, sum(len(t.time) for t in session)
        print(f"{path}: {len(session)} trials, {minutes:.1f} min, {samples:,} samples")
        for what, options in (("first look", ("--quick",)), ("whole", ())):
            with tempfile.TemporaryDirectory() as name:
                cold, warm = (seconds(path, Path(name), *options) for _ in range(2))
                programs = len(list((Path(name) / "compiled").glob("*-cache")))
                spent = f"{cold:3.0f} s with {programs} programs to compile, again {warm:3.0f} s"
                print(f"  {what + ':':12s} {spent}  ({verdict(Path(name))})", flush=True)


if __name__ == "__main__":
    main()
