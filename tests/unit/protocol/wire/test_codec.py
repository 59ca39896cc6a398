import dataclasses
import math
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import MessageError, Refusal
from protocol.machine.readings import KINDS, Encoder, Imu, columns
from protocol.machine.samples import COLUMNS, LIMITS, SAMPLE_DTYPE, empty
from protocol.wire import codec, keys
from protocol.wire.codec import (
    decode_batch,
    decode_corrections,
    decode_offer,
    encode_batch,
    encode_corrections,
    encode_offer,
)
from protocol.wire.fields import MAX_DEPTH, STORE_ID, pack, take_plain, unpack
from protocol.wire.messages import VERSION, Ack, CalibrationOffer, Health, Pose, Refused, SampleBatch, SensorBundle
from tests.golden import make as golden

EXTENT_M = 20_000.0
T0 = 1_750_000_000_000_000_000


def rows(n: int = 5) -> np.ndarray:
    one = (T0, 1.0, 2.0, 1.0, 0.5, 2.0, 0.1, 2.0, 0.5, 0.02, 1e-5, 0.1, -0.1, 1e-4, 1e-3, 0.01, 17_500.0, 0.25, 0.004)
    return np.array([one] * n, SAMPLE_DTYPE)


def batch(table: np.ndarray, **fields) -> SampleBatch:
    return SampleBatch(
        **{"machine": "m-1", "spool_id": 9, "first_seq": 1, "rows": table, "frame": "0123abcd", **fields}
    )


def changed(**fields) -> bytes:
    """A valid batch with replaced fields; ... removes one."""
    table = {**msgpack.unpackb(encode_batch(batch(rows()))), **fields}
    return msgpack.packb({name: value for name, value in table.items() if value is not ...})


def with_value(column: str, row: int, value: float) -> bytes:
    table = rows()
    table[column][row] = value
    return encode_batch(batch(table))


def refusal(data: bytes, decode=lambda data: decode_batch(data, EXTENT_M)) -> MessageError:
    with pytest.raises(MessageError) as caught:
        decode(data)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    return caught.value


# --- one clear error per kind of bad batch ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data", [b"", changed()[:10], changed()[:-1], changed() + b"\x00", b"\xc0", b"\x93\x01\x02\x03", b"\xa3abc"]
)
def test_what_is_cut_off_goes_on_or_is_no_map_is_refused(data):
    assert refusal(data).reason is Refusal.NOT_MSGPACK
    assert refusal(bytes(10 * 2**20)).reason is Refusal.TOO_LARGE, "and unread"


def test_lists_that_claim_more_than_comes_reserve_no_memory():
    nested = b"\x81\xa1v" + 200 * (b"\xdd" + (10**6).to_bytes(4, "big")) + bytes(10**6)
    tracemalloc.start()
    assert refusal(nested, lambda data: unpack(data, 2**21)).reason is Refusal.NOT_MSGPACK
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * len(nested), "200 lists of a million items would take 1.6 GB"


@pytest.mark.parametrize(
    ("fields", "reason", "field"),
    [
        ({"v": 2}, Refusal.VERSION, "v"),
        ({"n": -1}, Refusal.TOO_LARGE, "n"),
        ({"n": codec.MAX_BATCH_SAMPLES + 1}, Refusal.TOO_LARGE, "n"),
        ({"n": 4}, Refusal.COLUMN_LENGTH, "cols.stamp_ns"),
        ({"first_seq": 0}, Refusal.FIRST_SEQ, "first_seq"),
        ({"first_seq": 2**63}, Refusal.FIRST_SEQ, "first_seq"),
        ({"first_seq": codec.MAX_SEQ}, Refusal.FIRST_SEQ, "first_seq"),  # the last number is too large
        ({"lost_before": 1}, Refusal.OUT_OF_RANGE, "lost_before"),
        ({"lost_before": -1}, Refusal.OUT_OF_RANGE, "lost_before"),
        ({"spool_id": 0}, Refusal.OUT_OF_RANGE, "spool_id"),
        ({"machine": "*"}, Refusal.OUT_OF_RANGE, "machine"),
        ({"machine": "m" * 100_000}, Refusal.OUT_OF_RANGE, "machine"),
        ({"machine": b"m-1"}, Refusal.WRONG_TYPE, "machine"),
        ({"frame": ...}, Refusal.MISSING_FIELD, "frame"),
        ({"cols": ...}, Refusal.MISSING_FIELD, "cols"),
        ({"cols": {}}, Refusal.MISSING_FIELD, "stamp_ns"),
        ({"cols": msgpack.unpackb(changed())["cols"] | {"applied_zero": 0.001}}, Refusal.WRONG_TYPE, "applied_zero"),
    ],
)
def test_wrong_field_is_named(fields, reason, field):
    error = refusal(changed(**fields))
    assert (error.reason, error.field) == (reason, field)
    assert field in str(error)


@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize("change", [-1, 8])
def test_column_of_another_length_is_named(column, change):
    cols = msgpack.unpackb(changed())["cols"]
    cols[column] = cols[column][:change] if change < 0 else cols[column] + bytes(change)
    error = refusal(changed(cols=cols))
    assert (error.reason, error.field) == (Refusal.COLUMN_LENGTH, f"cols.{column}")


GROUPED = {"c_rr_var": "c_rr", "grade_n": "grade_e", "grade_var": "grade_e"}  # NaN together or not at all


@pytest.mark.parametrize("column", COLUMNS)
def test_bad_value_is_named_with_its_row(column):
    low, high = LIMITS.get(column, (-EXTENT_M, EXTENT_M))
    beyond = {"x": Refusal.OUTSIDE_SITE, "y": Refusal.OUTSIDE_SITE, "cov": Refusal.COVARIANCE}.get(
        column.split("_")[0], Refusal.OUT_OF_RANGE
    )
    bad = [(0, beyond), (-5, beyond)] if column == "stamp_ns" else [(low - 0.1, beyond), (1.01 * high + 1, beyond)]
    bad += [(-np.inf, Refusal.NOT_FINITE)] * (column != "stamp_ns")
    for value, reason in bad:
        error = refusal(with_value(column, 3, value))
        assert (error.reason, error.row, error.field) == (reason, 3, column), value
        assert f"{column}[3]" in str(error)
    if column not in ("stamp_ns", "mass_kg", "fuel_l"):
        error = refusal(with_value(column, 3, np.nan))
        assert (error.reason, error.row, error.field) == (Refusal.NOT_FINITE, 3, GROUPED.get(column, column))


def test_largest_batch_fits():
    assert len(encode_batch(batch(rows(codec.MAX_BATCH_SAMPLES)))) < codec.MAX_BATCH_BYTES


def test_unknown_resistance_gradient_or_mass_is_allowed():
    table = rows()
    for name in ("c_rr", "c_rr_var"):
        table[name][1] = np.nan
    for name in ("grade_e", "grade_n", "grade_var"):
        table[name][2] = np.nan
    table["mass_kg"][3] = table["fuel_l"][2] = np.nan
    assert decode_batch(encode_batch(batch(table)), EXTENT_M).rows.tobytes() == table.tobytes()


# --- round trips -----------------------------------------------------------------------------------------------------

names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,62}", fullmatch=True)
stamps = st.integers(1, 4_102_444_800_000_000_000)


@st.composite
def tables(draw):
    values = {
        "stamp_ns": stamps,
        **dict.fromkeys(("x_m", "y_m"), st.floats(-EXTENT_M, EXTENT_M)),
        **dict.fromkeys(("cov_xx_m2", "cov_yy_m2"), st.floats(0.0625, 1e5, width=32)),
        "cov_xy_m2": st.floats(-0.0625, 0.0625, width=32),
        **dict.fromkeys(("heading_rad", "grade_e", "grade_n"), st.floats(-4, 4, width=32)),
        **dict.fromkeys(("speed_mps", "distance_m", "c_rr_var", "grade_var"), st.floats(0, 50, width=32)),
        "c_rr": st.floats(-1, 5, width=32),
        "applied_zero": st.floats(-0.03125, 0.03125, width=32),
        "applied_scale": st.floats(-0.5, 0.5, width=32),
        "mass_kg": st.floats(1, 1e6, width=32),
        "aid_share": st.floats(0, 1, width=32),
        "fuel_l": st.floats(0, 100, width=32),
    }
    table = empty(draw(st.integers(0, 4)))
    for row in table:
        for name in COLUMNS:
            row[name] = draw(values[name])
    return table


@given(tables(), names, st.integers(1, 2**64 - 1), st.integers(1, 2**62 - 3), st.data())
def test_batch_round_trip(table, machine, spool_id, first_seq, data):
    lost = data.draw(st.integers(0, first_seq - 1))
    sent = batch(table, machine=machine, spool_id=spool_id, first_seq=first_seq, lost_before=lost)
    got = decode_batch(encode_batch(sent), EXTENT_M)
    assert got.rows.tobytes() == table.tobytes()
    assert (got.machine, got.spool_id, got.first_seq, got.lost_before, got.frame, got.last_seq) == (
        (machine, spool_id, first_seq, lost, "0123abcd", first_seq + len(table) - 1)
    )


counts = st.integers(0, codec.MAX_SEQ)


stores = st.from_regex(STORE_ID, fullmatch=True)
acks = st.builds(Ack, counts, counts, counts, stores, stores | st.just(""))


@given(acks | st.builds(Refused, st.text(max_size=20), st.text(max_size=200), counts, st.floats(0, codec.MAX_RETRY_S)))
def test_reply_round_trip(reply):
    assert codec.decode_reply(codec.encode_reply(reply)) == reply


@pytest.mark.parametrize("after_s", [-0.1, 3600.1, float("nan"), float("inf"), "1", True])
def test_a_server_cannot_keep_a_machine_waiting_for_ever(after_s):
    data = pack({"ack": False, "reason": "overloaded", "problem": "", "expected": 0, "retry_after_s": after_s})
    assert refusal(data, codec.decode_reply).field == "retry_after_s"


@st.composite
def reading_lists(draw):
    readings = []
    for kind, cls in KINDS.items():
        limits = [st.floats(low, high) for low, high in cls.limits.values()]
        readings += draw(st.lists(st.builds(cls, st.just(f"{kind}-1"), stamps, *limits), max_size=3))
    return readings


@settings(max_examples=30)
@given(names, st.integers(1, codec.MAX_SEQ), reading_lists(), st.booleans())
def test_bundle_round_trip_in_the_order_of_stamps(machine, counter, readings, last):
    got = codec.decode_bundle(codec.encode_bundle(SensorBundle(machine, counter, tuple(readings), last)))
    assert (got.machine, got.counter, got.last, got.refused) == (machine, counter, last, {})
    assert [r.stamp_ns for r in got.readings] == sorted(r.stamp_ns for r in readings)
    assert sorted(map(repr, got.readings)) == sorted(map(repr, readings))


# --- bundles ---------------------------------------------------------------------------------------------------------


def bundle_with(**fields) -> bytes:
    cols = {name: np.ones(2, "<f8").tobytes() for name in columns("encoder")}
    group = {
        "sensor": "axle",
        "kind": "encoder",
        "n": 2,
        "cols": {"stamp_ns": np.array([5, 6], "<i8").tobytes(), **cols},
    }
    return pack({"machine": "m-1", "counter": 1, "sensors": [{**group, **fields}]})


def test_implausible_reading_is_left_out_and_counted():
    readings = (Encoder("axle", T0, 1.0, 2.0), Encoder("axle", T0 + 1, float("nan"), 2.0), Imu("imu", 0, *[0.0] * 6))
    got = codec.decode_bundle(codec.encode_bundle(SensorBundle("m-1", 1, readings)))
    assert got.readings == readings[:1]
    assert got.refused == {Refusal.NOT_FINITE: 1, Refusal.OUT_OF_RANGE: 1}


@pytest.mark.parametrize(
    ("fields", "reason", "field"),
    [
        ({"kind": "sonar"}, Refusal.OUT_OF_RANGE, "kind"),
        ({"sensor": "a/b"}, Refusal.OUT_OF_RANGE, "sensor"),
        ({"n": 3}, Refusal.COLUMN_LENGTH, "axle.stamp_ns"),
        ({"n": 2**40}, Refusal.OUT_OF_RANGE, "n"),
        ({"cols": {}}, Refusal.MISSING_FIELD, "stamp_ns"),
    ],
)
def test_malformed_bundle_is_refused_whole(fields, reason, field):
    error = refusal(bundle_with(**fields), codec.decode_bundle)
    assert (error.reason, error.field) == (reason, field)


def test_bundle_has_a_counter_from_one_on_and_groups_that_are_maps():
    data = codec.encode_bundle(SensorBundle("m-1", 0, ()))
    assert refusal(data, codec.decode_bundle).field == "counter"
    for group in (1, [], None):
        data = pack({"machine": "m-1", "counter": 1, "sensors": [group]})
        assert refusal(data, codec.decode_bundle).field == "sensors"


@pytest.mark.parametrize(
    ("fields", "reason", "field"),
    [
        ({"base": "base/*"}, Refusal.OUT_OF_RANGE, "base"),
        ({"base": "base-2"}, Refusal.OUT_OF_RANGE, "base"),
        ({"stamp_ns": 2**62}, Refusal.OUT_OF_RANGE, "stamp_ns"),
        ({"frames": "text"}, Refusal.WRONG_TYPE, "frames"),
        ({"frames": None}, Refusal.MISSING_FIELD, "frames"),
        ({"frames": bytes(2**16)}, Refusal.TOO_LARGE, None),
        ({"problem": 3}, Refusal.WRONG_TYPE, "problem"),
        ({"v": 2}, Refusal.VERSION, "v"),
    ],
)
def test_bad_corrections_are_refused_and_their_field_named(fields, reason, field):
    table = msgpack.unpackb(encode_corrections(golden.CORRECTIONS)) | fields
    error = refusal(msgpack.packb(table), lambda data: decode_corrections(data, "base-1"))
    assert (error.reason, error.field) == (reason, field)


@pytest.mark.parametrize("stamp", [0, -1, 2**63])
def test_live_messages_carry_a_plausible_stamp(stamp):
    pose = Pose("m-1", stamp, *[0.0] * 7)
    assert refusal(codec.encode_pose(pose), codec.decode_pose).field == "stamp_ns"
    health = Health("m-1", stamp, {"readings": 0})
    if stamp:
        assert refusal(codec.encode_health(health), codec.decode_health).field == "stamp_ns"
    else:  # an agent without readings
        assert codec.decode_health(codec.encode_health(health)) == health


@pytest.mark.parametrize(
    ("changed", "key", "reason", "field"),
    [
        ({}, "m-2", Refusal.WRONG_MACHINE, "machine"),
        ({}, "*", Refusal.WRONG_MACHINE, "machine"),
        ({"x_m": 100.1}, "m-1", Refusal.OUT_OF_RANGE, "x_m"),
        ({"x_m": math.nan}, "m-1", Refusal.NOT_FINITE, "x_m"),
        ({"cov_yy_m2": 1e7}, "m-1", Refusal.OUT_OF_RANGE, "cov_yy_m2"),
        ({"cov_xy_m2": 0.3}, "m-1", Refusal.COVARIANCE, "cov_xy_m2"),
    ],
)
def test_a_pose_is_of_the_machine_of_its_key_and_where_a_sample_could_be(changed, key, reason, field):
    pose, extent_m = Pose("m-1", T0, 100.0, -100.0, 1.0, -2.0, 0.2, 0.1, 0.2), 100.0
    assert codec.receive_pose(keys.pose("pit", "m-1"), codec.encode_pose(pose), extent_m) == pose
    data = codec.encode_pose(dataclasses.replace(pose, **changed))
    error = refusal(data, lambda sent: codec.receive_pose(f"sitegrid/pit/machine/{key}/pose", sent, extent_m))
    assert (error.reason, error.field) == (reason, field)


def test_a_number_beyond_64_bits_is_the_greatest_and_anything_else_is_refused():
    assert unpack(pack({"n": [2**64 - 1, 2**64, 2**80], "m": -(2**63)}), 99) == {
        "v": VERSION,
        "n": [2**64 - 1] * 3,
        "m": -(2**63),
    }
    with pytest.raises(TypeError, match="object is no value"):
        pack({"n": object()})


# --- offers in acknowledgements --------------------------------------------------------------------------------------

OFFER = CalibrationOffer("loader-1", 1_750_000_000_000_000_000, 0.004, -0.05, 4e-7, 2e-5, 1e-6)
STORE_ID = "0123456789abcdef"


@pytest.mark.parametrize(
    ("changes", "reason", "field"),
    [
        ({"zero": math.nan}, Refusal.NOT_FINITE, "zero"),
        ({"zero": 0.201}, Refusal.OUT_OF_RANGE, "zero"),
        ({"scale": -0.51}, Refusal.OUT_OF_RANGE, "scale"),
        ({"zero_var": 0.0}, Refusal.OUT_OF_RANGE, "zero_var"),
        ({"covariance": 1e-5}, Refusal.OUT_OF_RANGE, "covariance"),
        ({"covariance": None}, Refusal.MISSING_FIELD, "covariance"),
        ({"machine": "*"}, Refusal.OUT_OF_RANGE, "machine"),
        ({"stamp_ns": 0}, Refusal.OUT_OF_RANGE, "stamp_ns"),
    ],
)
def test_a_bad_offer_is_named_and_its_acknowledgement_holds(changes, reason, field):
    ack = codec.decode_reply(codec.encode_reply(Ack(3, 1, store=STORE_ID, offer={**encode_offer(OFFER), **changes})))
    assert (ack.watermark, ack.store) == (3, STORE_ID)
    with pytest.raises(MessageError) as caught:
        decode_offer(ack.offer)
    assert (caught.value.reason, caught.value.field) == (reason, field)


@pytest.mark.parametrize("table", [7, "offer", [1.0], b"\x00"])
def test_what_is_no_table_is_no_offer(table):
    ack = codec.decode_reply(codec.encode_reply(Ack(3, 1, store=STORE_ID, offer=table)))
    with pytest.raises(MessageError, match="map expected"):
        decode_offer(ack.offer)


@pytest.mark.parametrize("nested", [lambda value: {"a": value}, lambda value: [value]])
def test_plain_values_nest_as_deep_as_the_protocol_says(nested) -> None:
    value = 1
    for _ in range(MAX_DEPTH - 1):
        value = nested(value)
    assert take_plain({"values": {"a": value}}, "values") == {"a": value}
    with pytest.raises(MessageError, match="nested more than 16 deep"):
        take_plain({"values": {"a": nested(value)}}, "values")
