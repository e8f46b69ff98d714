"""Atomic writing: a file appears whole or not at all if the disk fills up or the writing process is killed."""

import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest

from jaxfinger.data import read_session, write_session
from jaxfinger.data.atomic import MIN_ORPHAN_AGE, atomic_path, folder_to_fill
from jaxfinger.data.predictions import write_predictions
from jaxfinger.errors import UserError


@contextmanager
def room_for(size: int):
    """Limit files to `size` bytes, so that writing fails within a file as on a disk that fills up."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


WRITERS = {
    "session": lambda path, session: write_session(session, path, overwrite=True),
    "predictions": lambda path, session: write_predictions(
        path, session, {t.name: {"q": np.array(t.q)} for t in session}, overwrite=True
    ),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("size", [0, 1000, 6000])
def test_a_disk_that_fills_up_is_a_sentence_and_the_file_before_stays(session, tmp_path, writer, size):
    file = tmp_path / "a.h5"
    write_session(session, file)
    before = file.read_bytes()
    assert len(before) > 6000
    with room_for(size), pytest.raises(UserError, match=r"a\.h5: cannot be written .*free space"):
        WRITERS[writer](file, session)
    assert file.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.h5"]
    assert list(read_session(file).trials) == list(session.trials)


KILLED = """
import os, signal, sys, time
from jaxfinger.data.atomic import atomic_path
with atomic_path(sys.argv[1]) as part:
    part.write_text("half")
    if sys.argv[2] == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    print("writing", flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_process_left_is_removed_and_what_another_writes_is_not(tmp_path):
    file = tmp_path / "a.txt"
    dead = subprocess.run([sys.executable, "-c", KILLED, file, "die"], check=False)
    assert dead.returncode == -signal.SIGKILL
    (orphan,) = tmp_path.iterdir()
    (tmp_path / ".b.txt.x.part").write_text("of another file")
    young = tmp_path / ".a.txt.young.part"
    young.touch()
    old = tmp_path / ".a.txt.old.part"
    old.touch()
    os.utime(old, (0, time.time() - 2 * MIN_ORPHAN_AGE))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", KILLED, file, "live"], **pipes) as living:
        assert living.stdout.readline() == "writing\n"
        with atomic_path(file) as part:
            part.write_text("whole")
            names = {p.name for p in tmp_path.iterdir()}
            assert orphan.name not in names
            assert old.name not in names
            assert {young.name, ".b.txt.x.part"} <= names
            assert len(names) == 4  # The other two are the parts of the two writers.
        living.stdin.close()
    assert file.read_text() == "whole"


@pytest.mark.parametrize("ends", [KeyboardInterrupt, UserError, None])
def test_a_folder_that_work_made_and_did_not_fill_is_removed(tmp_path, ends):
    """However the work ends; a folder that was there before stays, and so does one that is filled."""
    (tmp_path / "mine").mkdir()

    def work(path, *fills):
        with folder_to_fill(tmp_path / path) as folder:
            assert folder.is_dir()
            for name in fills:
                (folder / name).touch()
            if ends is not None:
                raise ends

    for path in ("mine", "new", "mine/new", "a/b"):
        with nullcontext() if ends is None else pytest.raises(ends):
            work(path)
    assert [p.name for p in tmp_path.rglob("*")] == ["mine"]
    with nullcontext() if ends is None else pytest.raises(ends):
        work("a/b", "gap.json")
    assert (tmp_path / "a/b/gap.json").exists()


def test_a_folder_that_cannot_be_made_is_a_sentence_and_leaves_none(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file: is a file; choose another folder"), folder_to_fill(tmp_path / "file"):
        pass
    with pytest.raises(UserError, match="cannot be made"), folder_to_fill(tmp_path / "new" / ("x" * 300)):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
