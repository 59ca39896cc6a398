from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError, StoreError
from protocol.logfolder import open_log
from protocol.readings import Gps, Imu, Reading, parse_reading
from protocol.site import Projection
from sim import paper_site
from sim.config import SimConfig
from sim.recorder import record
from sim.simulator import Simulator
from sim.truth import TRACK_VALUES, TruthMap

CONFIG = SimConfig(seed=11, seconds=1.6)


def run(config: SimConfig) -> dict[str, list[Reading]]:
    simulator = Simulator(config)
    readings: dict[str, list[Reading]] = {m.name: [] for m in simulator.machines}
    for _ in range(config.bundles or 0):
        for name, new in simulator.advance().items():
            readings[name] += new
    return readings


def changed(**options: object) -> SimConfig:
    return replace(CONFIG, **options)  # type: ignore[arg-type]


BASE = run(CONFIG)


def test_same_seed_repeats_every_reading() -> None:
    assert run(CONFIG) == BASE
    assert run(changed(seed=12)) != BASE


def test_readings_do_not_depend_on_other_machines() -> None:
    assert run(changed(machines=1))["loader-1"] == BASE["loader-1"]
    more = run(changed(machines=7))
    assert all(more[name] == BASE[name] for name in BASE)


def test_readings_do_not_depend_on_the_other_sensors() -> None:
    def of(config: SimConfig, sensor: str) -> list[Reading]:
        return [r for r in run(config)["loader-2"] if r.sensor == sensor]

    for sensor in ("gps-1", "imu-1", "torque", "wheels"):
        assert of(changed(imus=3), sensor) == of(CONFIG, sensor)
    assert of(changed(gps=1, outage_s=0.0), "gps-1") == of(changed(gps=3, outage_s=0.0), "gps-1")


def test_readings_do_not_depend_on_the_bundles() -> None:
    def by_sensor(readings: dict[str, list[Reading]]) -> list[Reading]:
        return sorted(readings["loader-1"], key=lambda r: (r.sensor, r.stamp_ns))

    assert by_sensor(run(changed(bundle_ms=200))) == by_sensor(BASE)


def test_bundle_spans_what_the_config_says() -> None:
    for bundle_ms in (50, 100):
        simulator = Simulator(changed(bundle_ms=bundle_ms))
        for i in range(3):
            stamps = [r.stamp_ns - CONFIG.start_ns for r in simulator.advance()["loader-1"]]
            assert stamps == sorted(stamps)
            assert stamps[0] == (i * bundle_ms + 10) * 1_000_000
            assert stamps[-1] == (i + 1) * bundle_ms * 1_000_000
        assert simulator.simulated_s == pytest.approx(3 * bundle_ms / 1000)


def test_readings_come_at_their_rates() -> None:
    counts: dict[str, int] = {}
    for reading in run(changed(outage_s=0.0))["loader-1"]:
        counts[reading.sensor] = counts.get(reading.sensor, 0) + 1
    assert counts == {"gps-1": 8, "gps-2": 8, "imu-1": 160, "wheels": 32, "torque": 80, "articulation": 32}


def test_readings_are_valid_and_of_configured_sensors() -> None:
    sensors = {s.name: s.kind for s in Simulator(CONFIG).machines[0].sensors}
    for reading in BASE["loader-1"]:
        assert sensors[reading.sensor] == reading.kind
        values = tuple(getattr(reading, f.name) for f in fields(reading))[2:]
        assert all(type(v) is float for v in values), reading
        assert parse_reading(reading.kind, reading.sensor, reading.stamp_ns, values) == reading


def test_truth_is_never_in_the_readings() -> None:
    simulator = Simulator(CONFIG)
    projection = Projection(simulator.site)
    for _ in range(40):
        bundles = simulator.advance()
        state = simulator._world.state
        for i, readings in enumerate(bundles.values()):
            truths = np.concatenate([np.ravel(getattr(state, f.name)[i]) for f in fields(state)])
            truths = truths[(truths != 0) & (truths != np.round(truths))]
            for reading in readings:
                values = [getattr(reading, f.name) for f in fields(reading)[2:]]
                if isinstance(reading, Gps):
                    values += projection.to_map(reading.lat_deg, reading.lon_deg, reading.height_m)
                assert not set(values) & set(truths.tolist()), reading


def gps_fixes(config: SimConfig, sensor: str = "gps-1") -> np.ndarray:
    projection = Projection(paper_site.site(config.site))
    fixes = [r for r in run(config)["loader-1"] if isinstance(r, Gps) and r.sensor == sensor]
    return np.array([(r.stamp_ns, *projection.to_map(r.lat_deg, r.lon_deg, r.height_m)[:2]) for r in fixes])


def test_receivers_are_silent_in_turn() -> None:
    config = changed(machines=1, gps=3, seconds=10.0)
    stamps = [set(gps_fixes(config, f"gps-{i}")[:, 0].tolist()) for i in (1, 2, 3)]
    every = set.union(*stamps)
    assert [len(s) for s in stamps] == [45, 45, 45]
    silent = [every - s for s in stamps]
    assert not any(a & b for a, b in pairwise(silent))


def test_gps_options_change_the_noise() -> None:
    quiet = changed(machines=1, seconds=6.0, outage_s=0.0, gps_drift_std_m=0.0, gps_white_std_m=0.0)
    clean = gps_fixes(quiet)
    white = gps_fixes(replace(quiet, gps_white_std_m=0.7)) - clean
    assert white[:, 1:].std() == pytest.approx(0.7, rel=0.3)
    slow = gps_fixes(replace(quiet, gps_drift_std_m=1.2))[:, 1:] - clean[:, 1:]
    fast = gps_fixes(replace(quiet, gps_drift_std_m=1.2, gps_drift_time_s=0.5))[:, 1:] - clean[:, 1:]
    steps = [np.diff(e, axis=0).std() for e in (slow, fast)]
    assert steps[0] == pytest.approx(1.2 * np.sqrt(2 * (1 - np.exp(-0.2 / 60))), rel=0.3)
    assert steps[1] == pytest.approx(1.2 * np.sqrt(2 * (1 - np.exp(-0.2 / 0.5))), rel=0.3)


def test_outage_options_change_the_silence() -> None:
    shares = [
        len(gps_fixes(changed(machines=1, seconds=12.0, **o))) / 60
        for o in ({"outage_s": 0.0}, {"outage_s": 3.0, "outage_period_s": 6.0})
    ]
    assert shares == [1.0, 0.5]


def test_drive_speed_is_reached() -> None:
    for drive_mps in (2.0, 4.0):
        simulator = Simulator(changed(machines=2, seconds=0.0, drive_mps=drive_mps))
        for _ in range(160):
            simulator.advance()
        top = simulator.tracks()["loader-2"]["speed"].max()
        assert drive_mps - 0.3 < top < drive_mps + 1.0


def test_plain_options_reach_the_readings() -> None:
    simulator = Simulator(changed(site="pit", machines=2, names=("red", "blue"), gps=3, imus=2))
    assert simulator.site.name == "pit"
    assert [m.name for m in simulator.machines] == ["red", "blue"]
    assert {s.name for s in simulator.machines[0].sensors} >= {"gps-3", "imu-2"}
    shifted = run(changed(start_ns=CONFIG.start_ns + 5_000_000_000))["loader-1"]
    assert [r.stamp_ns - 5_000_000_000 for r in shifted] == [r.stamp_ns for r in BASE["loader-1"]]
    smooth, rough = (Simulator(changed(roughness_m=v)).truth_map.grade_north for v in (0.0, 0.03))
    assert abs(smooth).max() == 0 < abs(rough).max()


def test_machines_differ_from_nominal_by_a_few_per_cent() -> None:
    bodies = Simulator(changed(machines=100))._world._bodies  # type: ignore[attr-defined]
    mass = bodies.mass_kg / 17_500 - 1
    assert 0.02 < abs(mass).max() <= 0.03
    assert (bodies.wheel_radius_m / 0.75).std() == pytest.approx(0.015, rel=0.25)


def test_tracks_are_the_true_ways_at_10_hz() -> None:
    simulator = Simulator(CONFIG)
    assert len(simulator.tracks()["loader-1"]) == 0
    for _ in range(40):
        simulator.advance()
    for i, track in enumerate(simulator.tracks().values()):
        assert np.diff(track["stamp_ns"]).tolist() == [100_000_000] * 19
        assert track["stamp_ns"][0] == CONFIG.start_ns + 100_000_000
        assert track["x"][-1] == simulator._world.state.x_m[i]
        moved = np.hypot(np.diff(track["x"]), np.diff(track["y"]))
        np.testing.assert_allclose(moved, 0.1 * track["speed"][1:], atol=0.02)


def test_imu_sees_gravity_upwards_at_the_start() -> None:
    first = next(r for r in BASE["loader-1"] if isinstance(r, Imu))
    assert first.force_z_mps2 == pytest.approx(9.81, abs=0.5)


def test_recording_holds_the_same_readings_and_the_truth(tmp_path: Path) -> None:
    simulator = record(CONFIG, tmp_path / "logs", tmp_path / "truth")
    for machine in simulator.machines:
        log = open_log(tmp_path / "logs" / machine.name)
        assert log.machine == machine
        assert log.site == simulator.site
        assert list(log.readings()) == BASE[machine.name]  # in the same order, too
    truth = TruthMap.load(tmp_path / "truth" / "truth_map.npz")
    for f in fields(TruthMap):
        assert np.array_equal(getattr(truth, f.name), getattr(simulator.truth_map, f.name))
    lines = (tmp_path / "truth" / "tracks" / "loader-1.csv").read_text().splitlines()
    assert lines[0] == ",".join(("stamp_ns", *TRACK_VALUES))
    assert len(lines) == 17
    assert tuple(map(float, lines[-1].split(",")[1:])) == tuple(simulator.tracks()["loader-1"][-1].tolist()[1:])


def test_recording_without_an_end_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="seconds"):
        record(changed(seconds=0.0), tmp_path)


def test_broken_truth_map_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"PK\x03\x04 cut off", b"text"):
        (tmp_path / "truth.npz").write_bytes(content)
        with pytest.raises(StoreError, match=r"truth\.npz"):
            TruthMap.load(tmp_path / "truth.npz")
