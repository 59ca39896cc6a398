"""Write the golden messages beside this file: `PYTHONPATH=. python tests/golden/make.py`.

Only after a deliberate change of the wire and docs/protocol.md. Tests compare files and records both ways.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from protocol.errors import QueryError, Refusal
from protocol.machine.readings import Articulation, Attitude, Encoder, Gps, GpsVelocity, Imu, Odometry, Torque
from protocol.machine.samples import OPTIONAL, SAMPLE_DTYPE
from protocol.queries import answer_codec as answers
from protocol.queries import answers as records
from protocol.queries import lanes
from protocol.queries.calibration import (
    CalibrationAnswer,
    CorrectedSpan,
    MachineCalibration,
    decode_calibration,
    encode_calibration,
)
from protocol.queries.map_tiles import MapTile, TilesAnswer, decode_tiles, encode_tiles
from protocol.queries.origin import Origin, decode_origin, encode_origin
from protocol.queries.reasons import CellReasons, Votes, decode_why, encode_why
from protocol.queries.roads import (
    Fuel,
    RoadChange,
    RoadSegment,
    Segments,
    Worklist,
    WorklistRow,
    decode_segments,
    decode_worklist,
    encode_segments,
    encode_worklist,
)
from protocol.queries.routing import RouteAnswer, RouteMachine, RouteSteps, RouteTotals, decode_answer, encode_answer
from protocol.wire import codec
from protocol.wire.codec import decode_corrections, encode_corrections, encode_offer
from protocol.wire.fields import MAX_SMALL_BYTES, take_plain, unpack
from protocol.wire.messages import Ack, CalibrationOffer, Corrections, Health, Pose, Refused, SampleBatch, SensorBundle

FOLDER = Path(__file__).parent
STORE = "0123456789abcdef"
VERSION = records.MapVersion(STORE, 17, 3)
EXTENT_M = 20_000.0
T0 = 1_750_000_000_000_000_000
NAN = float("nan")


@dataclass(frozen=True)
class Golden:
    """One message: record, encoder, decoder."""

    record: Any
    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]


def rows() -> np.ndarray:
    """Four samples: complete, without gradient, without resistance, without both."""
    whole = (T0, 12.25, -40.5, 1.5, 0.25, 2.0, 0.5, 2.75, 0.55, 0.02, 1e-5, 0.125, -0.25, 1e-4)
    level = (T0 + 200_000_000, 12.75, -40.25, 1.5, -0.25, 2.0, 0.5, -2.75, 0.5, 0.25, 1e-5, NAN, NAN, NAN)
    ahead = (T0 + 400_000_000, 13.25, -40.0, 0.0, 0.0, 0.0, -3.0, 0.0, 0.0, NAN, NAN, 0.0, 0.0, 1e-4)
    place = (T0 + 600_000_000, 13.75, -39.75, 1.5, 0.25, 2.0, 0.5, 2.75, 0.5, NAN, NAN, NAN, NAN, NAN)
    calibration = (0.00390625, -0.0625)
    return np.array(
        [
            (*whole, *calibration, 17_500.0, 0.0, NAN),
            (*level, *calibration, 44_000.5, 0.0, NAN),
            (*ahead, 0.0, 0.0, NAN, 0.0, NAN),
            (*place, *calibration, 17_500.0, 0.0, NAN),
        ],
        SAMPLE_DTYPE,
    )


def aided(rows: np.ndarray) -> np.ndarray:
    """The samples of a machine localised on lanes."""
    rows["aid_share"] = 0.0, 0.25, 0.5, 1.0
    return rows


def fuelled() -> np.ndarray:
    """The samples of a machine that states its fuel, once not."""
    out = rows()
    out["fuel_l"] = 0.0078125, 0.0, NAN, 0.25
    return out


def readings() -> tuple[Any, ...]:
    """A reading of each kind, and one more."""
    return (
        Gps("gps-1", T0, 49.5, 8.25, 112.5, 1.5, 1.5, 4.0),
        Imu("imu-1", T0 + 1, 0.001, -0.002, 0.25, 0.1, -0.2, 9.80665),
        Attitude("ahrs", T0 + 2, 0.0, 0.0, 0.6, 0.8, 1e-4, 1e-4, 1e-2),
        Odometry("controller", T0 + 3, 1.5, 0.0, -0.25),
        Encoder("axle", T0 + 4, 1024.0, 1025.0),
        Torque("drive", T0 + 5, 12_500.0),
        Articulation("joint", T0 + 6, -0.125),
        Imu("imu-1", T0 + 10_000_000, 0.002, -0.001, 0.5, 0.2, -0.1, 9.75),
    )


def region() -> records.Region:
    """3 x 2 cells of 0.5 m, south-west corner (-1, 2)."""
    resistance = np.array([[0.02, NAN, 0.25], [NAN, 0.008, 0.04]], np.float32)
    return records.Region(
        x_m=np.array([-0.75, -0.25, 0.25]),
        y_m=np.array([2.25, 2.75]),
        cell_m=0.5,
        layers={"resistance": resistance, "visits": np.arange(6, dtype=np.float32).reshape(2, 3)},
        version=VERSION,
        stamp_ns=T0,
    )


def points() -> records.PointsAnswer:
    """Three places, one unknown."""
    layers = {"resistance": np.array([0.02, NAN, 0.25], np.float32), "visits": np.arange(3, dtype=np.float32)}
    return records.PointsAnswer(np.array([0.5, 1.5, -3.5]), np.array([2.5, 2.5, 0.5]), layers, VERSION, T0)


def piece() -> records.Region:
    """The region as the second of two pieces, two columns eastward."""
    return replace(region(), piece=records.Piece(123_456_789, 1, 2, 2, 0, 5, 2))


def decode_batch(data: bytes) -> SampleBatch:
    """Decode with the golden site's extent."""
    return codec.decode_batch(data, EXTENT_M)


def decode_info_table(data: bytes) -> dict[str, Any]:
    """Decode plain values; `decode_info` requires all fields of `MapInfo`."""
    return take_plain(unpack(data, MAX_SMALL_BYTES), "info")


BATCH = SampleBatch("loader-1", 0xFEDC_BA98_7654_3210, 41, rows(), "0123abcd")
AIDED = replace(BATCH, rows=aided(rows()))
LOST = SampleBatch("loader-1", 1, 101, rows(), "0123abcd", lost_before=60, store=STORE)
FUELLED = SampleBatch("loader-1", 1, 1, fuelled(), "0123abcd")
ASK = SampleBatch("loader-1", 7, 1, rows()[:0], "0123abcd")
OFFER = CalibrationOffer("loader-1", T0, 0.00390625, -0.0625, 2.0**-22, 2.0**-16, 2.0**-20)
POSE = Pose("loader-1", T0, 12.25, -40.5, 0.5, 2.75, 1.5, 0.25, 2.0)
CORRECTIONS = Corrections("base-1", T0, bytes.fromhex("d3000047ea4b"), "caster:2101: the caster hung up")
HEALTH = Health("loader-1", T0, {"spool": {"pending": 12, "dropped": 0}, "gps": "ok", "nis": 1.5, "names": ["a", "b"]})
POINT = records.PointAnswer(0.5, 1.5, {"resistance": 0.02, "visits": 3.0}, VERSION, T0)
SPANS = (
    records.HistorySpan(T0, T0 + 299_999_999_999, {"resistance": 0.25, "visits": 3.0}),
    records.HistorySpan(T0 + 600_000_000_000, T0 + 899_999_999_999, {"resistance": 0.02, "visits": 1.0}),
)
HISTORY = records.HistoryAnswer(0.5, 1.5, SPANS, VERSION, T0 + 700_000_000_000)
MACHINE = records.MachineState(
    name="loader-2",
    trusted=False,
    by="audit",
    reason="contradicts all others",
    since_ns=T0,
    contradicts=True,
    reasons=("offset",),
    evidence={"offset_m": 2.75, "machines": 3},
    spools=1,
    samples=1200,
    lost=3,
    newest_ns=T0 + 1,
    missing=5,
)
TRUST = records.TrustAnswer(**vars(MACHINE), store=STORE, merged=17, fact=3)
CHANGE = records.GroundChange(
    id=4,
    first_ns=T0,
    last_ns=T0 + 60_000_000_000,
    bounds=(10.0, -20.0, 40.0, 12.5),
    cells=615,
    resistance_before=0.25,
    resistance_after=0.0078125,
    grade_before=0.0,
    grade_after=None,
)
TILES = TilesAnswer(
    VERSION, T0, 0.5, whole=True, tiles=(MapTile(-1, 2, 17, 3, T0, zlib.compress(bytes(range(256)) * 96, 6)),)
)
SPAN = CorrectedSpan(T0, T0 + 300_000_000_000, 0.00251, -0.03125, -0.0005, 100.0)
CALIBRATED = MachineCalibration(
    name="loader-1",
    by="solver",
    reason="",
    since_ns=T0 + 1,
    zero=0.0025,
    zero_std=0.0005,
    scale=-0.03125,
    scale_std=0.0078125,
    across=None,
    across_std=None,
    zero_by=("heights", "same_ground"),
    scale_by=(),
    spans=(SPAN,),
)
CALIBRATION = CalibrationAnswer(STORE, 17, 3, T0 + 2, 0.03125, "no_slope_both_ways", (CALIBRATED,))
VOTES = Votes((0.01, 0.1), (1.5, 0.0), (0.0, 2.25))
WHY = CellReasons(
    store=STORE,
    merged=17,
    fact=3,
    stamp_ns=T0 + 9,
    x_m=0.5,
    y_m=1.5,
    cell_m=1.0,
    values={"resistance": 0.015625, "grade": None},
    before={"resistance": 0.25, "grade": None},
    metres=1.5,
    newest_ns=T0,
    changed_ns=T0 - 5,
    resistance=VOTES,
    grade_east=VOTES,
    grade_north=VOTES,
    sectors=(1.0, 0.5),
    machines=("loader-1", "loader-2"),
)
METRES = np.zeros(lanes.SHAPE, np.uint8)
METRES[4, 8::16] = 200
SLOPED = np.full(lanes.SLOPES, lanes.UNKNOWN_SLOPE, np.int8)
SLOPED[:, 1::4] = [[-127, -1, 0, 127], [3, 2, 1, 0]]
LANES = lanes.LanesAnswer(VERSION, T0, 1.0, (lanes.LaneTile(-1, 2, T0, 9, 2, 3, METRES, SLOPED),))
ERROR = QueryError(Refusal.UNKNOWN_LAYER, "layer `x` is not known")
OVERLOADED = QueryError(Refusal.OVERLOADED, "the server has too many queries to answer", 2.5)

STRETCH = RoadSegment(
    id="3_-2_e",
    line=((75.5, -49.5), (80.25, -44.0), (93.0, -31.5)),
    length_m=25.5,
    resistance=0.0625,
    resistance_std=0.0025,
    grade=-0.03125,
    trend=0.001,
    unmeasured=0.25,
    passes_ph=(12.5, 0.5),
    tonnes_ph=(550.0, 8.75),
    guessed=False,
    machines=4,
)
SPUR = replace(STRETCH, id="4_-2_e.1", resistance=None, resistance_std=None, grade=None, trend=None, guessed=True)
ROADS = Segments(STORE, 17, 3, T0, 1.5, 0.984375, (STRETCH, SPUR))
WORKLIST = Worklist(
    STORE,
    17,
    3,
    T0,
    1.5,
    0.02,
    4.5,
    (
        WorklistRow(
            1,
            STRETCH,
            (3.5, 3.25, 3.75),
            (1.0, 0.75, 1.25),
            (48.0, 45.0, 51.0),
            T0,
            0.03125,
            -2.5,
            (T0 - 24 * 3600 * 10**9, T0),
            (0.03125, 0.0625),
        ),
    ),
    (RoadChange("3_-2_e", STRETCH.line, T0, T0 + 60 * 10**9, 0.0625, 0.03125, 2.5),),
)
BURNT = Fuel((3.5, 3.25, 3.75), (3.0, 2.75, 3.25), 0.75)
BURNED = replace(
    WORKLIST,
    rows=(replace(WORKLIST.rows[0], segment=replace(STRETCH, fuel=BURNT)),),
    changes=(replace(WORKLIST.changes[0], fuel=BURNT),),
)
ROUTE = RouteAnswer(
    version=records.MapVersion(STORE, 17, 3),
    stamp_ns=T0 + 9,
    line_m=np.array([[0.0, 0.0], [30.0, 40.0]]),
    totals=RouteTotals(50.0, 1.5, 0.5, 0.25, 0.0625, 1e6, 9e5, 1.25e6, 2e5, 4e6, 20.0, 19.5, 21.0),
    steps=RouteSteps(*(np.array([i + 0.5, i - 0.25]) for i in range(8)), np.array([0.75, np.nan]), *np.ones((6, 2))),
    machine=RouteMachine(22_000.0, 6.0),
)

GOLDEN: dict[str, Golden] = {
    "batch.bin": Golden(BATCH, codec.encode_batch, decode_batch),
    "batch_aided.bin": Golden(AIDED, codec.encode_batch, decode_batch),
    "batch_lost.bin": Golden(LOST, codec.encode_batch, decode_batch),
    "batch_fuel.bin": Golden(FUELLED, codec.encode_batch, decode_batch),
    "batch_empty.bin": Golden(ASK, codec.encode_batch, decode_batch),
    "ack.bin": Golden(Ack(43, 17, 2, STORE), codec.encode_reply, codec.decode_reply),
    "ack_epoch.bin": Golden(Ack(43, 17, 2, STORE, epoch=7), codec.encode_reply, codec.decode_reply),
    "ack_replaces.bin": Golden(Ack(43, 17, 2, STORE, "fedcba9876543210"), codec.encode_reply, codec.decode_reply),
    "ack_offer.bin": Golden(Ack(43, 17, 0, STORE, offer=encode_offer(OFFER)), codec.encode_reply, codec.decode_reply),
    "refused.bin": Golden(Refused("gap", "first_seq: 41: 12 is expected", 12), codec.encode_reply, codec.decode_reply),
    "refused_later.bin": Golden(
        Refused("overloaded", "too many batches are waiting", retry_after_s=1.5), codec.encode_reply, codec.decode_reply
    ),
    "bundle.bin": Golden(SensorBundle("loader-1", 5, readings(), last=True), codec.encode_bundle, codec.decode_bundle),
    "bundle_velocity.bin": Golden(
        SensorBundle("loader-1", 6, (GpsVelocity("doppler", T0, 1.5, -0.25, 0.0625, 0.04),)),
        codec.encode_bundle,
        codec.decode_bundle,
    ),
    "pose.bin": Golden(POSE, codec.encode_pose, codec.decode_pose),
    "corrections.bin": Golden(CORRECTIONS, encode_corrections, partial(decode_corrections, base="base-1")),
    "health.bin": Golden(HEALTH, codec.encode_health, codec.decode_health),
    "point.bin": Golden(POINT, answers.encode_point, answers.decode_point),
    "points.bin": Golden(points(), answers.encode_points, answers.decode_points),
    "region.bin": Golden(region(), answers.encode_region, answers.decode_region),
    "tiles.bin": Golden(TILES, encode_tiles, decode_tiles),
    "lanes.bin": Golden(LANES, lanes.encode_lanes, lanes.decode_lanes),
    "why.bin": Golden(WHY, encode_why, decode_why),
    "route.bin": Golden(ROUTE, encode_answer, decode_answer),
    "segments.bin": Golden(ROADS, encode_segments, decode_segments),
    "worklist.bin": Golden(WORKLIST, encode_worklist, decode_worklist),
    "worklist_fuel.bin": Golden(BURNED, encode_worklist, decode_worklist),
    "calibration.bin": Golden(CALIBRATION, encode_calibration, decode_calibration),
    "piece.bin": Golden(piece(), answers.encode_region, answers.decode_region),
    "history.bin": Golden(HISTORY, answers.encode_history, answers.decode_history),
    "machines.bin": Golden(
        records.MachinesAnswer((MACHINE,), VERSION),
        answers.encode_machines,
        answers.decode_machines,
    ),
    "machine.bin": Golden(TRUST, answers.encode_machine, answers.decode_machine),
    "changes.bin": Golden(
        records.ChangesAnswer((CHANGE,), VERSION),
        answers.encode_changes,
        answers.decode_changes,
    ),
    "change.bin": Golden(CHANGE, answers.encode_change, answers.decode_change),
    "origin.bin": Golden(Origin("reader-1", 3, 0.25), encode_origin, decode_origin),
    "origin_server.bin": Golden(Origin(), encode_origin, decode_origin),
    "alive.bin": Golden(records.ServerAlive(STORE, 18, 17, 0.25), answers.encode_alive, answers.decode_alive),
    "info.bin": Golden({"site": "paper", "merged": 17, "refused": {"gap": 1}}, answers.encode_info, decode_info_table),
    "error.bin": Golden(ERROR, answers.encode_error, answers.decode_error),
    "overloaded.bin": Golden(OVERLOADED, answers.encode_error, answers.decode_error),
}
OLDER = "batch_older.bin"  # of an agent without own calibration
NEWER = "batch_newer.bin"  # of later software: an unknown field and an unknown column


def older_batch() -> bytes:
    """BATCH from an agent without own calibration."""
    table = msgpack.unpackb(codec.encode_batch(BATCH))
    cols = {name: column for name, column in table["cols"].items() if name not in OPTIONAL}
    return bytes(msgpack.packb({**table, "cols": cols}))


def newer_batch() -> bytes:
    """BATCH from a newer agent."""
    table = msgpack.unpackb(codec.encode_batch(BATCH))
    table["cols"]["slip"] = np.zeros(len(BATCH.rows), "<f4").tobytes()
    return bytes(msgpack.packb({**table, "firmware": "2.0"}))


def main() -> None:
    for name, golden in GOLDEN.items():
        (FOLDER / name).write_bytes(golden.encode(golden.record))
    (FOLDER / OLDER).write_bytes(older_batch())
    (FOLDER / NEWER).write_bytes(newer_batch())


if __name__ == "__main__":
    main()
