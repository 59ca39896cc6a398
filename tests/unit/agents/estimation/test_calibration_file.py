import json
from pathlib import Path
from typing import Any

import pytest

from agents.estimation.calibration import Calibration
from agents.estimation.calibration_file import _checksum, load, save
from protocol.errors import StoreError

KNOWN = Calibration(0.0031, -0.02, ((1e-6, -2e-7), (-2e-7, 1e-4)), 1_767_225_600_000_000_000, 41)


def test_what_was_saved_is_loaded_exactly_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    assert load(tmp_path / "c.json", "loader-1") is None
    save(tmp_path / "c.json", "loader-1", KNOWN)
    assert load(tmp_path / "c.json", "loader-1") == KNOWN
    assert [path.name for path in tmp_path.iterdir()] == ["c.json"]
    assert (tmp_path / "c.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("text", ["", "[]", "{", '{"version": 2}', "\x00\xff", "[" * 100_000])
def test_anything_else_is_refused_with_its_path(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.json").write_text(text, encoding="latin-1")
    with pytest.raises(StoreError, match=r"c\.json"):
        load(tmp_path / "c.json", "loader-1")


@pytest.mark.parametrize(
    "wrong",
    [
        {"machine": "loader-2"},
        {"zero": "a"},
        {"zero": float("nan")},
        {"zero": 0.3},
        {"scale": -0.6},
        {"covariance": [[1e-6, 1.0], [1.0, 1e-4]]},
        {"covariance": [[-1e-6, 0.0], [0.0, 1e-4]]},
        {"covariance": [[1e-6, 0.0]]},
        {"stamp_ns": -1},
        {"passages": None},
    ],
)
def test_senseless_numbers_are_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    path = tmp_path / "c.json"
    save(path, "loader-1", KNOWN)
    table = {**json.loads(path.read_text()), **wrong}
    del table["crc32"]
    path.write_text(json.dumps({**table, "crc32": _checksum(table)}))
    with pytest.raises(StoreError, match=r"c\.json: is (no|the) calibration"):
        load(path, "loader-1")


@pytest.mark.slow
def test_no_flipped_bit_is_used(tmp_path: Path) -> None:
    """Bits all over the file: the calibration is the one that was saved, or an error that names the file."""
    path = tmp_path / "c.json"
    save(path, "loader-1", KNOWN)
    whole, refused = path.read_bytes(), 0
    bits = range(0, 8 * len(whole), 5)
    for at in bits:
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            assert load(path, "loader-1") == KNOWN
        except StoreError as error:
            assert "c.json" in str(error)  # noqa: PT017 # blanks between values may be anything that is blank
            refused += 1
    assert refused > 0.9 * len(bits)
