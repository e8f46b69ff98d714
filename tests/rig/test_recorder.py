"""The recorder: a slow disk neither holds up the reader nor loses samples."""

import errno
import re
import threading
import time

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.rig import recorder as module
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block
from jaxfinger.rig.recorder import Recorder


def block(first, count=50):
    seq = np.arange(first, first + count, dtype=np.uint64)
    return Block(seq, seq, np.zeros((count, 2)), np.zeros(count, np.uint32), np.zeros(count, np.uint32))


class Slow(wal.LogWriter):
    """A disk that does not answer until `go` is set."""

    go = threading.Event()

    def write(self, tag, payload):
        self.go.wait(60)
        super().write(tag, payload)


def test_a_disk_that_stands_still_does_not_hold_up_the_reader(tmp_path):
    Slow.go = threading.Event()
    log = Recorder(tmp_path / "a.wal", {}, opener=Slow.create)
    for k in range(400):
        log.block(block(50 * k))
    assert log.waiting == 20_000  # all queued, none written: the disk has not answered yet
    Slow.go.set()
    log.close(60.0)
    assert log.failure is None
    seq = np.concatenate([f.block.seq for f in wal.read_log(log.path) if f.tag == wal.DATA])
    np.testing.assert_array_equal(seq, np.arange(20_000))


def test_a_disk_that_does_not_answer_is_waited_for_once(tmp_path):
    Slow.go = threading.Event()
    log = Recorder(tmp_path / "a.wal", {}, opener=Slow.create)
    log.close(0.1)
    assert log.hangs
    begun = time.monotonic()
    log.close(30.0)
    assert time.monotonic() - begun < 15.0
    Slow.go.set()


def test_a_disk_too_slow_for_too_long_is_a_reason_to_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "QUEUE_LIMIT", 1000)
    Slow.go = threading.Event()
    log = Recorder(tmp_path / "a.wal", {}, opener=Slow.create)
    for k in range(30):
        log.block(block(50 * k))
    assert log.failure is not None
    assert "too slow" in log.failure
    log.put(wal.END, {"complete": False})
    Slow.go.set()
    log.close()
    assert [f.tag for f in wal.read_log(log.path)][-1] == wal.END


def test_a_trial_whose_last_samples_the_disk_refused_is_not_complete(tmp_path):
    """A small frame may still fit where a block of samples does not."""

    class Full(wal.LogWriter):
        def write(self, tag, payload):
            if tag == wal.DATA:
                raise OSError(errno.ENOSPC, "No space left on device")
            super().write(tag, payload)

    log = Recorder(tmp_path / "a.wal", {}, opener=Full.create)
    log.block(block(0))
    log.put(wal.END, {"complete": True})
    log.close()
    end = next(f.json for f in wal.read_log(log.path) if f.tag == wal.END)
    assert not end["complete"]
    assert "No space left" in end["cause"]


def test_a_writer_that_fails_for_any_reason_is_a_reason_to_stop_and_goes_on(tmp_path):
    """A thread that ended would look like a slow disk for a second, and at the end of a run like nothing at all."""

    class Odd(wal.LogWriter):
        def write(self, tag, payload):
            if tag == wal.DATA:
                raise ValueError("write to closed file")
            super().write(tag, payload)

    log = Recorder(tmp_path / "a.wal", {}, opener=Odd.create)
    log.block(block(0))
    log.put(wal.END, {"complete": True})
    log.close()
    assert log.failure == "a.wal cannot be written: ValueError: write to closed file"
    assert (log.waiting, log.waiting_s) == (0, 0.0)
    assert not next(f.json for f in wal.read_log(log.path) if f.tag == wal.END)["complete"]


def test_a_folder_that_is_missing_is_a_sentence(tmp_path):
    with pytest.raises(UserError, match="choose a folder that exists"):
        Recorder(tmp_path / "missing" / "a.wal", {})


def test_a_full_disk_is_a_sentence_and_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MIN_FREE_BYTES", 1 << 60)
    with pytest.raises(UserError, match="MiB are free; a session needs"):
        Recorder(tmp_path / "a.wal", {})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="MiB are free; a session needs"):
        Recorder(tmp_path / "a.wal", {}, resume=True)


def test_a_log_that_has_taken_its_frames_lacks_nothing_and_one_that_hangs_is_said(tmp_path):
    Slow.go = threading.Event()
    log = Recorder(tmp_path / "a.wal", {}, opener=Slow.create)
    assert log.lacks(0.05) == "a.wal: the disk does not answer within 0.05 s"
    Slow.go.set()
    assert log.lacks(60.0) == ""
    log.close(60.0)


def test_a_disk_that_takes_only_a_short_frame_more_is_full(tmp_path, monkeypatch):
    """The last block of a file has room where the disk has none."""
    log = Recorder(tmp_path / "a.wal", {})
    assert log.lacks(60.0) == ""
    monkeypatch.setattr(module, "ARM_FREE_BYTES", 1 << 60)
    assert re.fullmatch(f"{tmp_path}: only [0-9]+ MiB are free", log.lacks(60.0))
    log.close()
