import io
import math
import random
from collections import Counter
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import pynmeagps
import pytest
import pyubx2

from agents.drivers.formats import EARLIEST_NS, FIX, HEADING, IMU, TIME, VELOCITY, WEEK_NS, Message
from agents.drivers.formats.framing import FRAMINGS, Framer
from agents.drivers.formats.gpsd import GpsdDecoder
from agents.drivers.formats.nmea import NmeaDecoder
from agents.drivers.formats.ubx import UbxDecoder
from agents.drivers.line import Line
from protocol.machine.machine_config import SensorConfig
from sim.receivers.nmea import sentence as nmea
from sim.receivers.ubx import frame as framed
from tests.unit.agents.drivers.frames import GGA, RMC, TEN, TPV, esf, pvt, recording, report, spoiled, ubx

GST = "GNGST,101527.20,0.8,0.021,0.014,12.0,0.020,0.015,0.03"
SENSORS = {
    "fix": SensorConfig("gps-1", "gps"),
    "velocity": SensorConfig("doppler", "gps_velocity", std={"velocity": 0.05}),
    "heading": SensorConfig("compass", "attitude", measures=("heading",)),
    "imu": SensorConfig("imu-1", "imu"),
    "wheels": SensorConfig("wheels", "encoder"),
}


def messages(decoder: Any, *frames: bytes, host_ns: int = 0) -> list[Message]:
    """Messages decoded from whole frames, without bare times."""
    whole = [frame for data in frames for frame in Framer(FRAMINGS).feed(data)]
    made = [message for frame in whole for message in decoder.decode(frame.data, host_ns)]
    return [message for message in made if message.stream != TIME]


def last(made: list[Message], stream: str) -> Message:
    return [message for message in made if message.stream == stream][-1]


# --- framing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("piece", [1, 64, 1 << 20])
@pytest.mark.parametrize(("format_", "frame"), [("ubx", pvt()), ("nmea", nmea(GGA)), ("gpsd", report(TPV))])
def test_every_whole_frame_among_broken_ones_is_read(format_: str, frame: bytes, piece: int) -> None:
    stream, whole = spoiled([frame] * 300)
    framer, read = Framer(FRAMINGS), Counter[str]()
    for begin in range(0, len(stream), piece):
        frames = framer.feed(stream[begin : begin + piece])
        read.update(one.format for one in frames if one.data.strip() == frame.strip())
    assert read[format_] == whole
    assert framer.broken > 0


def test_a_frame_is_out_with_its_last_byte_whatever_lengths_before_it_promise() -> None:
    framer, frame = Framer(FRAMINGS), pvt()
    assert framer.feed(b'\xb5\x62\x01\x07\xf0\x0f{"class":$GNGGA,' + frame[:-1]) == []
    assert [out.data for out in framer.feed(frame[-1:])] == [frame]


BY_CHANCE = b"\xb5b" + bytes.fromhex("050102008a23b562")  # a frame whose checksum equals the next one's head


@pytest.mark.parametrize("piece", [1, 5, 1 << 20])
def test_a_false_frame_whose_checksum_fits_by_chance_hides_no_whole_one(piece: int) -> None:
    """The false frame shares two bytes with the next; another, too long, holds both."""
    whole = ubx("NAV-EOE", iTOW=5)
    around = framed(5, 1, BY_CHANCE[:-2] + whole)
    framer, stream = Framer(FRAMINGS), BY_CHANCE[:-2] + whole + b"abc" + around
    read = [f.data for at in range(0, len(stream), piece) for f in framer.feed(stream[at : at + piece])]
    assert read == [BY_CHANCE, whole, BY_CHANCE, whole, around]
    assert framer.broken == 3


# --- against the oracles ---------------------------------------------------------------------------------------------


def test_nav_pvt_has_what_the_oracle_reads() -> None:
    draw = random.Random(3)
    for _ in range(100):
        place = {"lat_1e7": draw.randrange(-9 * 10**8, 9 * 10**8), "lon_1e7": draw.randrange(-18 * 10**8, 18 * 10**8)}
        motion = {name: draw.randrange(-20_000, 20_000) for name in ("north_mmps", "east_mmps", "height_mm")}
        stated = ("horizontal_acc_mm", "vertical_acc_mm", "speed_acc_mmps")
        accuracy = {name: draw.randrange(1, 10**5) for name in stated}
        frame = pvt(**place, **motion, **accuracy, nano=draw.randrange(-9, 9))
        oracle, (fix, moving) = pyubx2.UBXReader.parse(frame), messages(UbxDecoder(), frame)
        variances = [(std / 1e3) ** 2 for std in (oracle.hAcc, oracle.hAcc, oracle.vAcc)]
        assert fix.values == pytest.approx((oracle.lat, oracle.lon, oracle.height / 1e3, *variances), abs=1e-9)
        known = oracle.velE / 1e3, oracle.velN / 1e3, (oracle.sAcc / 1e3) ** 2, (oracle.sAcc / 1e3) ** 2
        assert moving.values == pytest.approx(known)
        assert fix.utc_ns == moving.utc_ns == TEN * 10**9 + oracle.nano
        assert (fix.quality, fix.satellites) == ("fixed", 24)


def test_relposned_has_the_heading_at_its_time_of_week() -> None:
    valid = {"gnssFixOK": 1, "relPosValid": 1, "relPosHeadingValid": 1}
    frame = ubx("NAV-RELPOSNED", version=1, iTOW=382_545_125, relPosHeading=271.25, accHeading=0.25, **valid)
    turned, oracle = last(messages(UbxDecoder(), pvt(), frame), HEADING), pyubx2.UBXReader.parse(frame)
    assert turned.utc_ns == TEN * 10**9 + 125_000_000
    *_, z, w, _, _, variance = turned.values
    assert math.degrees(2 * math.atan2(z, w)) == pytest.approx(90 - oracle.relPosHeading)
    assert variance == pytest.approx(math.radians(oracle.accHeading) ** 2)
    invalid = ubx("NAV-RELPOSNED", version=1, iTOW=382_545_125, relPosHeading=271.25, gnssFixOK=1, relPosValid=1)
    assert messages(UbxDecoder(), invalid) == []


def test_an_imu_is_complete_once_rates_and_forces_of_one_time_are_there() -> None:
    forces = esf(105, (16, 1024), (17, -512), (18, 10_042))
    rates = esf(100, (14, 4096), (13, -4096), (5, 8192), (12, 3))
    (reading,) = messages(UbxDecoder(), forces, rates)
    degree = math.radians(1)
    assert reading.values == pytest.approx((degree, -degree, 2 * degree, 1.0, -0.5, 10_042 / 1024))
    assert messages(UbxDecoder(), forces, esf(200, (14, 1), (13, 1), (5, 1))) == [], "a frame was lost"


def test_wheels_count_on_where_their_counter_starts_again_and_down_in_reverse() -> None:
    decoder, top, back = UbxDecoder(), (1 << 23) - 1, 1 << 23
    counted = enumerate([(top, 5), (4, 8), (6 | back, 9 | back)])
    frames = [esf(100 * i, (8, left), (9, right)) for i, (left, right) in counted]
    assert [message.values for message in messages(decoder, *frames)] == [(0, 0), (5, 3), (3, 2)]


def test_sentences_have_what_the_oracle_reads() -> None:
    made = messages(NmeaDecoder(), nmea(GGA), nmea(RMC), nmea(GST), nmea(GGA))
    oracle, deviations = (pynmeagps.NMEAReader.parse(nmea(text)) for text in (GGA, GST))
    fix, moving = last(made, FIX), last(made, VELOCITY)
    variances = (std**2 for std in (deviations.stdLong, deviations.stdLat, deviations.stdAlt))
    assert fix.values == pytest.approx((oracle.lat, oracle.lon, oracle.alt + oracle.sep, *variances), abs=1e-9)
    assert (fix.satellites, fix.quality, fix.utc_ns) == (oracle.numSV, "fixed", TEN * 10**9 + 200_000_000)
    east, north, *_ = moving.values
    assert math.hypot(east, north) == pytest.approx(4.179 * 1852 / 3600)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(86.8)


def test_gpsd_states_no_accuracy_of_its_own() -> None:
    fix, moving = messages(GpsdDecoder(), report(TPV))
    assert (fix.values[:3], fix.utc_ns) == ((49.0101234, 8.4005678, 157.3), TEN * 10**9 + 200_000_000)
    assert moving.values[:2] == pytest.approx((2.15, 0.0))
    assert all(map(math.isnan, (*fix.values[3:], *moving.values[2:])))
    line = Line("gpsd", {"fix": SensorConfig("gps-1", "gps", std={"position": 2.0})})
    assert line.feed(report(TPV), 1)[1].values[3:] == (4.0, 4.0, 4.0)
    assert len(line.feed(report({name: value for name, value in TPV.items() if name != "lat"}), 1)) == 1, "the time"


# --- time ------------------------------------------------------------------------------------------------------------


def fix_at(decoder: NmeaDecoder, time: str) -> int:
    return last(messages(decoder, nmea(GGA.replace("101527.20", time))), FIX).utc_ns


def stamp(*date: int) -> int:
    return round(datetime(*date, tzinfo=UTC).timestamp()) * 10**9  # type: ignore[misc, arg-type]


def test_a_time_without_date_has_that_of_the_sentence_before_and_midnight_between() -> None:
    decoder = NmeaDecoder()
    assert fix_at(decoder, "101527.20") == 0, "no date yet"
    messages(decoder, nmea(RMC.replace("101527.20", "235959.00").replace("261126", "311226")))
    assert fix_at(decoder, "235959.50") == stamp(2026, 12, 31, 23, 59, 59) + 500_000_000
    assert fix_at(decoder, "000000.00") == stamp(2027, 1, 1)
    assert fix_at(decoder, "235959.75") == stamp(2026, 12, 31, 23, 59, 59) + 750_000_000, "one that was late"


def test_zda_is_a_date_too_but_a_receiver_without_fix_may_guess() -> None:
    decoder, zda = NmeaDecoder(), nmea("GNZDA,101527.00,26,11,2026,00,00")
    messages(decoder, zda)
    assert fix_at(decoder, "101527.20") == 0
    messages(decoder, zda)
    assert fix_at(decoder, "101527.40") == TEN * 10**9 + 400_000_000


def test_a_leap_second_is_the_next_minute_and_a_week_that_rolled_over_is_this_one() -> None:
    decoder = NmeaDecoder()
    messages(decoder, nmea(RMC.replace("101527.20", "235960.00").replace("261126", "311226")))
    assert fix_at(decoder, "000000.00") == stamp(2027, 1, 1)
    assert messages(UbxDecoder(), pvt(hour=23, minute=59, second=60))[0].utc_ns == stamp(2026, 11, 27)
    old = datetime.fromtimestamp(TEN - 2 * 1024 * WEEK_NS // 10**9, UTC)
    made = messages(UbxDecoder(), pvt(year=old.year, month=old.month, day=old.day))
    assert made[0].utc_ns == TEN * 10**9 >= EARLIEST_NS
    messages(decoder, nmea(RMC.replace("261126", f"{old:%d%m%y}")))
    assert fix_at(decoder, "101528.00") == (TEN + 1) * 10**9
    assert messages(UbxDecoder(), pvt(valid=3))[0].utc_ns == 0, "leap seconds are not known yet"


@pytest.mark.parametrize(("after_ms", "utc_ms"), [(5, 200), (60, 200), (95, 300)])
def test_a_heading_without_time_belongs_to_the_epoch_around_it(after_ms: int, utc_ms: int) -> None:
    """Also ahead of its epoch's sentences."""
    decoder = NmeaDecoder()
    for i in (0, 1):
        messages(decoder, nmea(RMC.replace("27.20", f"27.{i + 1}0")), host_ns=i * 10**8)
    (turned,) = messages(decoder, nmea("GNTHS,87.1,A"), host_ns=10**8 + after_ms * 10**6)
    assert turned.utc_ns == TEN * 10**9 + utc_ms * 10**6
    assert messages(decoder, nmea("GNTHS,87.1,E")) == [], "estimated"


# --- unknown values --------------------------------------------------------------------------------------------------


def test_zeros_are_no_accuracy() -> None:
    fix = last(messages(NmeaDecoder(), nmea(RMC), nmea("GNGST,101527.20,,,,,0.0,0.0,0.0"), nmea(GGA)), FIX)
    assert fix.values[3:] == pytest.approx((0.012**2, 0.012**2, 0.024**2)), "by HDOP"
    line = Line("ubx", {"fix": SENSORS["fix"]})
    assert [value.sensor for value in line.feed(pvt(horizontal_acc_mm=0), 1)] == [""]
    assert line.counters["without_value"] == 1


@pytest.mark.parametrize(
    "frame",
    [
        *(pvt(fix_type=0), pvt(flags=0), pvt(fix_type=1), report({"class": "TPV", "mode": 1})),
        *(nmea(GGA.replace(",E,4,", f",E,{quality},")) for quality in (0, 6, 8)),
        nmea("GNGGA,,,,,,0,00,99.99,,,,,,"),
    ],
)
def test_a_receiver_without_fix_has_no_position(frame: bytes) -> None:
    format_ = {b"\xb5": "ubx", b"$": "nmea"}.get(frame[:1], "gpsd")
    line = Line(format_, SENSORS)
    assert [value.sensor for value in line.feed(frame, 1) if value.sensor] == []
    assert line.counters["no_fix"] == 1


def test_standing_without_a_course_is_no_motion() -> None:
    (moving,) = messages(NmeaDecoder(), nmea(RMC.replace("4.179,86.80", "0.31,")))
    assert moving.values == pytest.approx((0, 0, *((0.31 * 1852 / 3600) ** 2,) * 2))


def test_talkers_are_receivers_of_their_own_where_a_table_says_so() -> None:
    both = nmea(RMC.replace("GN", "GP")) + nmea(GGA.replace("GN", "GP")) + nmea(RMC) + nmea(GGA)
    line = Line("nmea", {"gp:fix": SENSORS["fix"], "gn:fix": SensorConfig("gps-2", "gps")})
    assert [value.sensor for value in line.feed(both, 1) if value.sensor] == ["gps-1", "gps-2"]
    assert [v.sensor for v in Line("nmea", SENSORS).feed(both, 1) if v.kind == "gps"] == ["gps-1"] * 2


# --- recordings of real receivers ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nmea_drive_f9k.nmea", "nmea_rtk_short.log"])
def test_a_recorded_drive_by_nmea_has_what_the_oracle_reads(name: str) -> None:
    """The second starts with a place before any date."""
    data = recording(name).read_bytes()[:300_000]
    fixes = [v for v in Line("nmea", SENSORS).feed(data, None) if v.kind == "gps"]
    sentences = pynmeagps.NMEAReader(io.BytesIO(data), quitonerror=0, nmeaonly=False)
    oracle = [m for _, m in sentences if m is not None and m.msgID == "GGA" and m.quality in (1, 2, 4, 5)]
    undated = int(oracle[0].time.microsecond > 0)
    assert len(fixes) == len(oracle) - undated > 90
    for value, known in zip(fixes, oracle[undated:], strict=True):
        assert value.values[:2] == pytest.approx((known.lat, known.lon), abs=1e-8)
        assert value.values[2] == pytest.approx(known.alt + known.sep)
        time = datetime.fromtimestamp(value.utc_ns // 10**9, UTC)
        assert (time.year, time.time()) == (2020, known.time.replace(microsecond=0))


def test_a_recorded_ubx_drive_has_what_the_oracle_reads() -> None:
    data = recording("ubx_m8l_esf_hnr.log").read_bytes()
    observed = Line("ubx", SENSORS).feed(data, None)
    oracle = [m for _, m in pyubx2.UBXReader(io.BytesIO(data), protfilter=2, quitonerror=0) if m is not None]
    places = [place for m in oracle if m.identity == "NAV-PVT" for place in (m.lat, m.lon)]
    assert [place for v in observed if v.kind == "gps" for place in v.values[:2]] == pytest.approx(places, abs=1e-9)
    ticks = [m.dataField_01 for m in oracle if m.identity == "ESF-MEAS" and m.dataType_01 == 10]
    counted = [v.values[0] for v in observed if v.kind == "encoder"]  # once the file has stated the time
    assert counted == [(t & 0x7FFFFF) - ticks[0] for t in ticks][-len(counted) :]
    forces = [m.dataField_03 / 1024 for m in oracle if m.identity == "ESF-MEAS" and getattr(m, "dataType_03", 0) == 18]
    imu = [v for v in observed if v.kind == IMU]
    assert {v.values[5] for v in imu} <= set(forces)
    assert len(imu) > 0.95 * len(forces)
    steps_ns = [after.host_ns - before.host_ns for before, after in pairwise(imu)]
    assert sorted(steps_ns)[5] > 89e6, "by the sensors' clock, not in bursts of a second"
    assert max(steps_ns) < 92e6
