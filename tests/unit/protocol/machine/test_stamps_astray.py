"""Far-off stamps of a file are refused singly; after a clock's setting the rest counts."""

from pathlib import Path

import pytest

from protocol.machine.log_folder import LogFolder, open_log

T0, DAY, YEARS = 1_750_000_000, 86_400.0, 20 * 365 * 86_400.0
EVEN = [round(0.2 * i, 3) for i in range(400)]
SENSOR = """
[[sensor]]
name = "{0}"
kind = "articulation"
file = "{0}.csv"
columns = {{ stamp = "t", angle_rad = "a" }}
"""


def log_of(folder: Path, **stamps_s: list[float]) -> LogFolder:
    head = f'log = {{ name = "x", start_ns = {T0}000000000 }}\nmachine = {{ name = "m" }}\n'
    site = 'site = { name = "y", origin_lat_deg = 50.0, origin_lon_deg = 8.0 }\n'
    (folder / "log.toml").write_text(head + site + "".join(map(SENSOR.format, stamps_s)))
    for name, stamps in stamps_s.items():
        (folder / f"{name}.csv").write_text("t,a\n" + "".join(f"{stamp:.3f},0.1\n" for stamp in stamps))
    return open_log(folder)


def shifted(stamps: list[float], by_s: float) -> list[float]:
    return [stamp + by_s for stamp in stamps]


ASTRAY = {  # rows, refusals by reason
    "first ahead": ([YEARS, *EVEN], {"stamp_ahead": 1}),
    "first behind": ([-YEARS, *EVEN], {"stamp_goes_back": 1}),
    "a day ahead": ([*EVEN[:300], DAY, *EVEN[300:]], {"stamp_ahead": 1}),
    "an hour behind": ([*EVEN[:300], -3600.0, *EVEN[300:]], {"stamp_goes_back": 1}),
    "a week ahead, soon": ([*EVEN[:30], 7 * DAY, *EVEN[30:]], {"stamp_ahead": 1}),
    "two in a row": ([*EVEN[:300], DAY, DAY + 0.2, *EVEN[300:]], {"stamp_ahead": 2}),
    "last ahead": ([*EVEN, DAY], {"stamp_ahead": 1}),
    "set after 30 s": ([*shifted(EVEN[:150], YEARS), *EVEN], {"stamp_ahead": 150}),
    "set after 20 s": ([*shifted(EVEN[:100], -YEARS), *EVEN], {"stamp_goes_back": 100}),
    "set back by an hour": ([*EVEN, *shifted(EVEN, -3600)], {}),
    "set ahead by an hour": ([*EVEN, *shifted(EVEN, 3600)], {}),
    "a pause": ([*EVEN[:100], *shifted(EVEN[100:], 60)], {}),
    "one row a minute": ([60.0 * i for i in range(10)], {}),
    "one row": ([0.0], {}),
}


@pytest.mark.parametrize(("stamps", "refused"), ASTRAY.values(), ids=ASTRAY)
def test_rows_that_are_far_off_are_refused_and_no_other(
    tmp_path: Path, stamps: list[float], refused: dict[str, int]
) -> None:
    log = log_of(tmp_path, a=stamps)
    assert len(list(log.readings())) == len(stamps) - sum(refused.values())
    assert log.refused == refused


def test_a_file_without_any_order_is_refused_in_time(tmp_path: Path) -> None:
    log = log_of(tmp_path, a=[-10.0 * i for i in range(5_000)])
    assert len(list(log.readings())) + log.refused["stamp_goes_back"] == 5_000


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_sensors_whose_clock_was_set_stay_in_step(tmp_path: Path, step_s: float) -> None:
    """Throughout: no sensor is over two rows ahead of the other."""
    rows = [*EVEN, *shifted(EVEN, EVEN[-1] + 0.2 + step_s)]
    names = [reading.sensor for reading in log_of(tmp_path, a=rows, b=shifted(rows, 0.05)).readings()]
    assert len(names) == 2 * len(rows)
    ahead = [names[:i].count("a") - names[:i].count("b") for i in range(0, len(names), 50)]
    assert max(map(abs, ahead)) <= 2
