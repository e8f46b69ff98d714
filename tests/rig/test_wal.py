"""The log: every prefix of it can be read, and damage costs only the frames that it touches."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.errors import UserError
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block


def block(first: int, count: int, channels: int = 3, lost: int = 0) -> Block:
    seq = np.arange(first, first + count, dtype=np.uint64)
    x = np.arange(count * channels, dtype=float).reshape(count, channels) + first
    return Block(seq, seq * 1_000_000, x, np.full(count, 2, np.uint32), np.full(count, 1 << 16, np.uint32), lost)


def frames_in(data: bytes):
    """Yield the sound frames of a log in memory."""
    return wal.frames(io.BytesIO(data))


class Pieces(io.BytesIO):
    """A file that keeps its length after every write in `ends`, and may write less than it is given."""

    def __init__(self, most: int = 1 << 30):
        super().__init__()
        self.most, self.ends = most, [0]

    def write(self, data):
        count = super().write(bytes(data[: self.most]))
        self.ends.append(self.tell())
        return count


def a_log(most: int = 1 << 30) -> tuple[Pieces, list[int]]:
    file = Pieces(most)
    writer = wal.LogWriter(file)
    writer._write(wal.MAGIC)
    writer.write(wal.HEADER, wal.pack_json({"specimen": "s"}))
    ends = [file.tell()]
    for i in range(12):
        writer.write(wal.DATA, wal.pack_block(block(50 * i, 50)))
        ends.append(file.tell())
    return file, ends


def test_killed_at_every_write():
    """After each write, even of half a frame, every whole frame before it can be read."""
    file, ends = a_log(most=700)
    data = file.getvalue()
    for cut in file.ends[1:]:
        whole = sum(end <= cut for end in ends)
        found = list(frames_in(data[:cut]))
        assert len(found) == whole
        samples = sum(len(f.block) for f in found if f.tag == wal.DATA)
        assert samples == 50 * max(whole - 1, 0)


def test_killed_at_every_byte_of_a_frame():
    file, ends = a_log()
    data = file.getvalue()
    for cut in range(ends[3], ends[4] + 1):
        assert len(list(frames_in(data[:cut]))) == (4 if cut < ends[4] else 5)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_flipped_bit_costs_only_the_frame_that_it_hits(data):
    file, ends = a_log()
    image = bytearray(file.getvalue())
    at = data.draw(st.integers(len(wal.MAGIC), len(image) - 1))
    image[at] ^= 1 << data.draw(st.integers(0, 7))
    hit = sum(end <= at for end in ends)
    starts = [len(wal.MAGIC), *ends]
    whole, found = list(frames_in(file.getvalue())), list(frames_in(bytes(image)))
    assert [f.payload for f in found] == [f.payload for i, f in enumerate(whole) if i != hit]
    assert [(f.start, f.damaged) for f in found if f.damaged] == [
        (end, end - start) for start, end in zip(starts, ends, strict=False) if start <= at < end and end != ends[-1]
    ]


@pytest.mark.parametrize("most", [7, 64, 1 << 20])
def test_the_search_for_the_next_frame_finds_a_tag_wherever_it_lies(monkeypatch, most):
    monkeypatch.setattr(wal, "_SEARCH_BYTES", most)
    file, ends = a_log()
    image = bytearray(file.getvalue())
    image[ends[3] : ends[4]] = bytes(ends[4] - ends[3])
    assert [f.damaged for f in frames_in(bytes(image))] == [0, 0, 0, 0, ends[4] - ends[3], *[0] * 7]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 30), st.integers(1, 20), st.integers(0, 2**60), st.integers(0, 5), st.integers(0, 2**31))
def test_blocks_survive_the_round_trip(count, channels, first, lost, seed):
    rng = np.random.default_rng(seed)
    seq = np.arange(first, first + count, dtype=np.uint64)
    x = rng.standard_normal((count, channels))
    x[rng.random(x.shape) < 0.1] = np.nan
    sent = Block(seq, seq + 7, x, rng.integers(0, 9, count, np.uint32), rng.integers(0, 2**32, count, np.uint32), lost)
    (frame,) = frames_in(wal.MAGIC + wal.pack_frame(wal.DATA, wal.pack_block(sent)))
    got = frame.block
    for name in ("seq", "t_ns", "x", "state", "flags"):
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))
    assert got.lost_before == lost


def test_going_on_after_a_torn_frame(tmp_path):
    file, ends = a_log()
    path = tmp_path / "a.wal"
    path.write_bytes(file.getvalue()[: ends[5] + 33])
    writer = wal.LogWriter.append(path)
    writer.write(wal.DATA, wal.pack_block(block(1000, 10)))
    writer.close()
    blocks = [f.block for f in wal.read_log(path) if f.tag == wal.DATA]
    assert len(blocks) == 6
    assert int(blocks[-1].seq[0]) == 1000


def test_a_full_disk_leaves_no_half_frame():
    class Full(io.BytesIO):
        room = 3000

        def write(self, data):
            if self.tell() + len(data) > self.room:
                super().write(bytes(data[: self.room - self.tell()]))
                raise OSError(28, "No space left on device")
            return super().write(bytes(data))

    file = Full()
    writer = wal.LogWriter(file)
    writer._write(wal.MAGIC)
    writer.write(wal.DATA, wal.pack_block(block(0, 40)))
    with pytest.raises(OSError, match="No space"):
        writer.write(wal.DATA, wal.pack_block(block(40, 400)))
    writer.write(wal.END, wal.pack_json({"complete": False}))
    assert [f.tag for f in frames_in(file.getvalue())] == [wal.DATA, wal.END]


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "x.wal").write_bytes(b"something else entirely")
    with pytest.raises(UserError, match="not a recording log"):
        list(wal.read_log(tmp_path / "x.wal"))
    (tmp_path / "y.wal").write_bytes(wal.MAGIC)
    with pytest.raises(UserError, match="interrupted here"):
        wal.LogWriter.create(tmp_path / "y.wal")
    with pytest.raises(UserError, match="cannot be read"):
        list(wal.read_log(tmp_path / "none.wal"))


def test_a_second_recorder_does_not_write_to_the_log(tmp_path):
    """Two would each write over the other's frames."""
    path = tmp_path / "s.h5.wal"
    first = wal.LogWriter.create(path)
    first.write(wal.HEADER, wal.pack_json({}))
    with pytest.raises(UserError, match=r"s\.h5\.wal: another recorder writes to it; end that one first"):
        wal.LogWriter.append(path)
    first.close()
    wal.LogWriter.append(path).close()


def test_a_log_that_cannot_be_written_is_a_sentence(tmp_path):
    with pytest.raises(UserError, match=r"none\.wal: cannot be written \(No such file or directory\)"):
        wal.LogWriter.append(tmp_path / "none.wal")
