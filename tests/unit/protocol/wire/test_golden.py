"""The wire never changes by accident: stored bytes, records and code agree both ways."""

import dataclasses

import numpy as np
import pytest

from tests.golden import make as golden
from tests.paths import GOLDEN

FOLDER = GOLDEN
NAMES = sorted(path.name for path in FOLDER.glob("*.bin"))


def same(a, b) -> bool:
    """Equality of records, NaN and arrays by bytes."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, Exception):
        return type(a) is type(b) and str(a) == str(b) and vars(a) == vars(b)
    return a == b


def test_every_message_has_a_golden_file():
    assert sorted([*golden.GOLDEN, golden.OLDER, golden.NEWER]) == NAMES


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("batch_older.bin", "batch_newer.bin")])
def test_golden_file_decodes_to_the_record_and_back(name):
    entry, data = golden.GOLDEN[name], (FOLDER / name).read_bytes()
    assert same(entry.decode(data), entry.record)
    assert entry.encode(entry.decode(data)) == data


def test_unknown_field_and_column_of_a_newer_agent_are_ignored():
    assert same(golden.decode_batch((FOLDER / golden.NEWER).read_bytes()), golden.BATCH)


def test_an_agent_that_states_neither_calibration_nor_mass_has_applied_none_and_is_of_unknown_mass():
    rows = golden.BATCH.rows.copy()
    rows["applied_zero"] = rows["applied_scale"] = 0.0
    rows["mass_kg"] = np.nan
    older = golden.decode_batch((FOLDER / golden.OLDER).read_bytes())
    assert same(older, dataclasses.replace(golden.BATCH, rows=rows))


def test_columns_and_types_are_the_specified_ones():
    from protocol.machine.samples import SAMPLE_DTYPE

    assert SAMPLE_DTYPE.names[:3] == ("stamp_ns", "x_m", "y_m")
    assert [SAMPLE_DTYPE[name].str for name in SAMPLE_DTYPE.names] == ["<i8", "<f8", "<f8", *["<f4"] * 16]
