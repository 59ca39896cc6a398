"""A checkpoint on disk: read whole or in part, and never believed where it is damaged."""

from pathlib import Path

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.grid_state import GridState
from mapserver.past.checkpoint_file import MAGIC, Checkpoint, CheckpointWriter, DamagedError, Header
from protocol.site.geometry import CellWindow
from tests.unit.mapserver.data import filled_to, folded, random_samples, same

HEADER = Header(7200, 41, {"store": "x", "excluded": ["a"]}, 3, 4, 5, 6)


def written(path: Path, state: GridState) -> Path:
    with path.open("wb") as file:
        writer = CheckpointWriter(file)
        for x, y, pages in state.blocks:
            writer.add(x, y, pages)
        writer.finish(HEADER)
        assert file.tell() == writer.bytes_written
    return path


def read(path: Path, window: CellWindow | None = None) -> Grid:
    with Checkpoint(path) as checkpoint:
        blocks = tuple(checkpoint.blocks(checkpoint.numbers_in(window)))
        return Grid.from_state(1.0, FoldConfig(), GridState(blocks, 0, 0, 0, 0))


@pytest.fixture(scope="module")
def state() -> GridState:
    return folded(random_samples(300, 3)).state()


@pytest.mark.parametrize("count", [None, 2**16, 2**32 - 1])
def test_what_is_written_is_read(tmp_path, state, count):
    state = filled_to(state, count) if count else state
    path = written(tmp_path / "one", state)
    with Checkpoint(path) as checkpoint:
        assert checkpoint.header == HEADER
        assert len(checkpoint.index) == len(state.blocks)
    assert same(read(path), Grid.from_state(1.0, FoldConfig(), GridState(state.blocks, 0, 0, 0, 0)))


@pytest.mark.parametrize("window", [(-16, -16, 32, 32), (0, 0, 1, 1), (-1, 15, 2, 2), (500, 500, 9, 9)])
def test_the_blocks_of_a_window_are_read_alone(tmp_path, state, window):
    column, row, columns, rows = window
    path = written(tmp_path / "one", state)
    got = [(x, y) for x, y, _ in read(path, CellWindow(*window)).state().blocks]
    assert got == [
        (x, y)
        for x, y, _ in state.blocks
        if column < 16 * (x + 1) and 16 * x < column + columns and row < 16 * (y + 1) and 16 * y < row + rows
    ]
    size, data = path.stat().st_size, bytearray(path.read_bytes())
    with Checkpoint(path) as checkpoint:
        others = np.setdiff1d(np.arange(len(checkpoint.index)), checkpoint.numbers_in(CellWindow(*window)))
        firsts = checkpoint.index["first"][others].tolist()
    for first in firsts:  # damage elsewhere is not looked at
        data[first] ^= 1
    path.write_bytes(data)
    assert path.stat().st_size == size
    assert [(x, y) for x, y, _ in read(path, CellWindow(*window)).state().blocks] == got


def test_no_flipped_bit_is_believed(tmp_path, state):
    seed = 5
    path = written(tmp_path / "one", GridState(state.blocks[:2], 0, 0, 0, 0))
    data, good = path.read_bytes(), read(path)
    draw = np.random.default_rng(seed)
    at = {*draw.integers(0, len(data), 100).tolist(), *range(len(data) - 300, len(data)), *range(len(MAGIC))}
    for place in at:
        flipped = bytearray(data)
        flipped[place] ^= 1 << int(draw.integers(8))
        path.write_bytes(flipped)
        try:
            got = read(path)
        except DamagedError:
            continue
        assert same(got, good), f"seed {seed}, byte {place}"
        assert place < len(MAGIC), "only the first bytes say nothing that anybody uses"


@pytest.mark.parametrize("keep", [0, 3, 100, -1, -30, -5000])
def test_a_file_that_was_cut_is_damaged(tmp_path, state, keep):
    path = written(tmp_path / "one", state)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DamagedError):
        read(path)


@pytest.mark.parametrize("data", [b"", b"SGCHECK1", b"x" * 5000, b"SGCHECK1" + bytes(200) + b"SGCHECK1"])
def test_a_foreign_file_is_damaged(tmp_path, data):
    (tmp_path / "one").write_bytes(data)
    with pytest.raises(DamagedError, match=r"one: its (end|header) is damaged; it is made again"):
        Checkpoint(tmp_path / "one")
