"""The child process that reads a file first survives sound files, and dies of damaged ones."""

import time

import h5py
import numpy as np
import pytest

from jaxfinger.data import probe
from jaxfinger.data.opening import why_closed


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "s.h5"
    with h5py.File(path, "w") as opened:
        for i in range(50):
            opened[f"trials/{i}/q"] = np.zeros(3)
        opened["trials/again"] = opened["trials/1"]  # a second name for a group
        opened["trials/up"] = h5py.SoftLink("/trials")
    return path


def test_a_sound_file_survives(file):
    assert probe.survives(file)


def test_what_raises_in_the_walk_does_not_survive(file, monkeypatch):
    def walk(*arguments):
        raise RuntimeError("a broken tree")

    monkeypatch.setattr(probe, "_walk", walk)
    assert not probe.survives(file)
    assert why_closed(file).startswith("is damaged in its structure")


def test_a_busy_machine_damages_no_file_and_a_circle_does(file, monkeypatch):
    """The limit is one of processor time, of which sleep takes none."""
    monkeypatch.setattr(probe, "_MAX_CPU_TIME", 0.1)
    monkeypatch.setattr(probe, "_walk", lambda *_: time.sleep(0.5))
    assert probe.survives(file)

    def circle(*arguments):
        while True:
            pass

    monkeypatch.setattr(probe, "_walk", circle)
    assert not probe.survives(file)


def test_more_objects_than_fit_are_a_circle(file, monkeypatch):
    monkeypatch.setattr(probe, "_MIN_OBJECT_SIZE", 10**6)
    assert not probe.survives(file)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "is empty"), (b"text, no HDF5" * 100, "is not an HDF5 file"), (None, "does not exist")],
)
def test_why_a_file_does_not_open(tmp_path, content, words):
    path = tmp_path / "s.h5"
    if content is not None:
        path.write_bytes(content)
    assert words in why_closed(path)


def test_a_file_whose_end_is_missing(file):
    file.write_bytes(file.read_bytes()[:-2000])
    assert "is truncated" in why_closed(file)
