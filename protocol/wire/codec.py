"""Messages to bytes and back, validated: MessageError names field and row."""

from collections import Counter
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from protocol.errors import MessageError, Refusal, one_line
from protocol.machine.readings import KINDS, MAX_STAMP_NS, Reading, columns, parse_reading
from protocol.machine.samples import AIDED, COLUMNS, FUEL, LIMITS, OPTIONAL, SAMPLE_DTYPE, check_samples, empty
from protocol.site.site_config import MAX_EXTENT_M
from protocol.wire.fields import (
    MAX_INT,
    MAX_SMALL_BYTES,
    check,
    pack,
    take,
    take_int,
    take_name,
    take_plain,
    take_stamp,
    take_store,
    unpack,
)
from protocol.wire.messages import (
    Ack,
    CalibrationOffer,
    Corrections,
    Health,
    PackedBatch,
    Pose,
    Refused,
    SampleBatch,
    SensorBundle,
)

MAX_BATCH_BYTES = 4 * 2**20
MAX_BATCH_SAMPLES = 20_000
MAX_BUNDLE_BYTES = 2**20
MAX_SEQ = 2**62
MAX_RETRY_S = 3600.0
MAX_CORRECTIONS_BYTES = 16 * 2**10  # a base with all satellites and signals sends 2 kB a second
MOST_VAR = 1.0  # of an offer's zero and scale: more is no knowledge
_WIDTHS = tuple(SAMPLE_DTYPE[name].itemsize for name in COLUMNS)
_STAND_IN = {name: np.array(value, SAMPLE_DTYPE[name]).tobytes() for name, value in OPTIONAL.items()}


# --- samples ---------------------------------------------------------------------------------------------------------


def encode_batch(batch: SampleBatch) -> bytes:
    """Little-endian columns of SAMPLE_DTYPE; AIDED and FUEL only if informative."""
    is_stated = {AIDED: batch.rows[AIDED].any(), FUEL: np.isfinite(batch.rows[FUEL]).any()}
    names = [name for name in COLUMNS if is_stated.get(name, True)]
    table: dict[str, Any] = {
        "machine": batch.machine,
        "spool_id": batch.spool_id,
        "first_seq": batch.first_seq,
        "n": len(batch.rows),
        "frame": batch.frame,
        "cols": {name: np.ascontiguousarray(batch.rows[name]).tobytes() for name in names},
    }
    if batch.lost_before:
        table["lost_before"] = batch.lost_before
    if batch.store:
        table["store"] = batch.store
    return pack(table)


def decode_batch(data: bytes, extent_m: float) -> SampleBatch:
    """Decode and check a batch; one bad sample refuses it. extent_m: bound of positions. Unknown fields are ignored."""
    packed = unpack_batch(data)
    rows = np.empty(packed.n, SAMPLE_DTYPE)
    for name, column in zip(COLUMNS, packed.columns, strict=True):
        rows[name] = np.frombuffer(column, SAMPLE_DTYPE[name])
    check_samples(rows, extent_m)
    return replace(packed.batch, rows=rows)


def unpack_batch(data: bytes) -> PackedBatch:
    """Check a batch except its samples."""
    table = unpack(data, MAX_BATCH_BYTES)
    n = take_int(table, "n", 0, MAX_BATCH_SAMPLES, Refusal.TOO_LARGE)
    first_seq = take_int(table, "first_seq", 1, MAX_SEQ - max(0, n - 1), Refusal.FIRST_SEQ)
    lost_before = take_int({"lost_before": 0, **table}, "lost_before", 0, first_seq - 1)
    batch = SampleBatch(
        machine=take_name(table),
        spool_id=take_int(table, "spool_id", 1, MAX_INT),
        first_seq=first_seq,
        rows=empty(),
        frame=take(table, "frame", str),
        lost_before=lost_before,
        store=take_store(table, optional=True),
    )
    return PackedBatch(batch, n, _columns(take(table, "cols", dict), n))


def _columns(cols: dict[str, Any], n: int) -> tuple[bytes, ...]:
    missing = {name: n * value for name, value in _STAND_IN.items() if cols.get(name) is None}
    columns: tuple[Any, ...] = tuple(map((cols | missing).get, COLUMNS))
    for name, width, data in zip(COLUMNS, _WIDTHS, columns, strict=True):
        if type(data) is not bytes:
            take(cols, name, bytes)
        elif len(data) != n * width:
            problem = f"{len(data)} bytes, {n} samples take {n * width}"
            raise MessageError(Refusal.COLUMN_LENGTH, problem, field=f"cols.{name}")
    return columns


def encode_reply(reply: Ack | Refused) -> bytes:
    """The server's reply to a batch."""
    table: dict[str, Any]
    if isinstance(reply, Ack):
        table = {"ack": True, "watermark": reply.watermark, "row": reply.row, "trimmed": reply.trimmed}
        table |= {"store": reply.store} | ({"replaces": reply.replaces} if reply.replaces else {})
        table |= {"epoch": reply.epoch} if reply.epoch else {}
        return pack(table | ({"offer": reply.offer} if reply.offer else {}))
    table = {"ack": False, "reason": reply.reason, "problem": reply.problem, "expected": reply.expected}
    return pack(table | ({"retry_after_s": reply.retry_after_s} if reply.retry_after_s else {}))


def decode_reply(data: bytes) -> Ack | Refused:
    """Undo `encode_reply`."""
    table = unpack(data, MAX_SMALL_BYTES)
    if take(table, "ack", bool):
        watermark, row, trimmed = (take_int(table, name, 0, MAX_SEQ) for name in ("watermark", "row", "trimmed"))
        replaces = take_store(table, "replaces", optional=True)
        epoch = take_int(table, "epoch", 0, MAX_SEQ) if "epoch" in table else 0
        return Ack(watermark, row, trimmed, take_store(table), replaces, table.get("offer"), epoch)
    expected, retry_after_s = take_int(table, "expected", 0, MAX_SEQ), take(table, "retry_after_s", float, 0.0)
    if not 0 <= retry_after_s <= MAX_RETRY_S:
        problem = f"{retry_after_s} is not between 0 and {MAX_RETRY_S}"
        raise MessageError(Refusal.OUT_OF_RANGE, problem, field="retry_after_s")
    return Refused(take(table, "reason", str), take(table, "problem", str), expected, retry_after_s)


# --- readings --------------------------------------------------------------------------------------------------------


def encode_bundle(bundle: SensorBundle) -> bytes:
    """Readings as columns by sensor."""
    groups: dict[tuple[str, str], list[Reading]] = {}
    for reading in bundle.readings:
        groups.setdefault((reading.sensor, reading.kind), []).append(reading)
    sensors = [_encode_group(sensor, kind, readings) for (sensor, kind), readings in groups.items()]
    return pack({"machine": bundle.machine, "counter": bundle.counter, "last": bundle.last, "sensors": sensors})


def _encode_group(sensor: str, kind: str, readings: list[Reading]) -> dict[str, Any]:
    cols = {name: np.array([getattr(r, name) for r in readings], "<f8").tobytes() for name in columns(kind)}
    stamps = np.array([r.stamp_ns for r in readings], "<i8").tobytes()
    return {"sensor": sensor, "kind": kind, "n": len(readings), "cols": {"stamp_ns": stamps, **cols}}


def decode_bundle(data: bytes) -> SensorBundle:
    """Decode a bundle; readings in stamp order.

    A malformed bundle is refused; implausible readings are counted in `refused`.
    """
    table = unpack(data, MAX_BUNDLE_BYTES)
    refused: Counter[str] = Counter()
    readings: list[Reading] = []
    for group in take(table, "sensors", list):
        if not isinstance(group, dict):
            raise MessageError(Refusal.WRONG_TYPE, "map expected", field="sensors")
        readings += _decode_group(group, refused)
    readings.sort(key=lambda r: r.stamp_ns)
    return SensorBundle(
        machine=take_name(table),
        counter=take_int(table, "counter", 1, MAX_SEQ),
        readings=tuple(readings),
        last=take(table, "last", bool, default=False),
        refused=dict(refused),
    )


def _decode_group(group: dict[str, Any], refused: Counter[str]) -> list[Reading]:
    sensor, kind = take_name(group, "sensor"), take(group, "kind", str)
    if kind not in KINDS:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{kind[:40]!r} is none of {', '.join(KINDS)}", field="kind")
    n, cols = take_int(group, "n", 0, MAX_BATCH_SAMPLES), take(group, "cols", dict)
    arrays = []
    for name in ("stamp_ns", *columns(kind)):
        data: bytes = take(cols, name, bytes)
        if len(data) != 8 * n:
            raise MessageError(Refusal.COLUMN_LENGTH, f"{len(data)} bytes for {n} readings", field=f"{sensor}.{name}")
        arrays.append(np.frombuffer(data, "<i8" if name == "stamp_ns" else "<f8").tolist())
    readings = []
    for stamp_ns, *values in zip(*arrays, strict=True):
        try:
            readings.append(parse_reading(kind, sensor, stamp_ns, tuple(values)))
        except MessageError as error:
            refused[error.reason] += 1
    return readings


# --- live pose and health --------------------------------------------------------------------------------------------


def encode_pose(pose: Pose) -> bytes:
    """A live position."""
    return pack({name: getattr(pose, name) for name in Pose.__dataclass_fields__})


def decode_pose(data: bytes) -> Pose:
    """Undo `encode_pose`."""
    table = unpack(data, MAX_SMALL_BYTES)
    numbers = (take(table, name, float) for name in list(Pose.__dataclass_fields__)[2:])
    return Pose(take_name(table), take_stamp(table), *numbers)


def receive_pose(key: str, data: bytes, extent_m: float = MAX_EXTENT_M) -> Pose:
    """Decode a live position and check it against its key and sample limits; extent_m: bound of positions."""
    pose = decode_pose(data)
    if not key.endswith(f"/machine/{pose.machine}/pose"):
        raise MessageError(Refusal.WRONG_MACHINE, f"{pose.machine!r} sends under {key}", field="machine")
    limits = {**LIMITS, "x_m": (-extent_m, extent_m), "y_m": (-extent_m, extent_m)}
    for name in list(Pose.__dataclass_fields__)[2:]:
        (low, high), value = limits[name], getattr(pose, name)
        if not low <= value <= high:
            raise MessageError(Refusal.OUT_OF_RANGE, f"{value:g} is not between {low:g} and {high:g}", field=name)
    if pose.cov_xy_m2**2 > pose.cov_xx_m2 * pose.cov_yy_m2 + 1e-6 * max(pose.cov_xx_m2 * pose.cov_yy_m2, 1e-12):
        raise MessageError(Refusal.COVARIANCE, "covariance is not positive semidefinite", field="cov_xy_m2")
    return pose


def encode_health(health: Health) -> bytes:
    """A health report."""
    return pack({"machine": health.machine, "stamp_ns": health.stamp_ns, "values": dict(health.values)})


def decode_health(data: bytes) -> Health:
    """Undo `encode_health`."""
    table = unpack(data, MAX_SMALL_BYTES)
    stamp_ns = take_int(table, "stamp_ns", 0, MAX_STAMP_NS)  # 0 before the first reading
    return Health(take_name(table), stamp_ns, take_plain(table, "values"))


# --- corrections ------------------------------------------------------------------------------------------------------


def encode_corrections(message: Corrections) -> bytes:
    """A relay's message."""
    return pack(vars(message))


def decode_corrections(data: bytes, base: str) -> Corrections:
    """Undo `encode_corrections`; refused from another base."""
    table = unpack(data, MAX_CORRECTIONS_BYTES)
    if (sender := take_name(table, "base")) != base:
        raise MessageError(Refusal.OUT_OF_RANGE, f"of {sender}, on the key of {base}", field="base")
    problem = one_line(take(table, "problem", str, ""))
    return Corrections(sender, take_stamp(table), take(table, "frames", bytes), problem)


# --- offers of a calibration ------------------------------------------------------------------------------------------


def encode_offer(offer: CalibrationOffer) -> dict[str, Any]:
    """An offer as a table."""
    return asdict(offer)


def decode_offer(table: Any) -> CalibrationOffer:
    """Undo `encode_offer`; implausible values are refused."""
    if not isinstance(table, dict):
        raise MessageError(Refusal.WRONG_TYPE, f"map expected, not {type(table).__name__}", field="offer")
    names = ("zero", "scale", "zero_var", "scale_var", "covariance")
    values = {name: take(table, name, float) for name in names}
    for name in ("zero", "scale"):
        low, high = LIMITS[f"applied_{name}"]
        check(low <= values[name] <= high, name, f"{values[name]} is not between {low} and {high}")
        variance = values[f"{name}_var"]
        check(0 < variance <= MOST_VAR, f"{name}_var", f"{variance} is not above 0, up to {MOST_VAR}")
    product = values["zero_var"] * values["scale_var"]
    check(values["covariance"] ** 2 < product, "covariance", "not positive definite")
    return CalibrationOffer(take_name(table), take_stamp(table), **values)
