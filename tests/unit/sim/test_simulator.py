import os
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.machine.log_folder import open_log
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection
from sim.config import SimConfig
from sim.recorder import record
from sim.simulator import BUNDLE_MS, START_NS, Simulator
from sim.truth import TRACK_DTYPE, TruthMap

CONFIG = SimConfig(seed=11, seconds=1.6, world="fast")


def run(config: SimConfig, bundle_ms: int = BUNDLE_MS) -> dict[str, list[Reading]]:
    with closing(Simulator(config, bundle_ms=bundle_ms)) as simulator:
        readings: dict[str, list[Reading]] = {m.name: [] for m in simulator.machines}
        for _ in range(simulator.bundles or 0):
            for name, new in simulator.advance().items():
                readings[name] += new
    return readings


def changed(**options: object) -> SimConfig:
    return replace(CONFIG, **options)  # type: ignore[arg-type]


BASE = run(CONFIG)


def test_bundle_spans_what_the_config_says() -> None:
    for bundle_ms in (50, 100):
        simulator = Simulator(CONFIG, bundle_ms=bundle_ms)
        for i in range(3):
            stamps = [r.stamp_ns - START_NS for r in simulator.advance()["loader-1"]]
            assert stamps == sorted(stamps)
            assert stamps[0] == (i * bundle_ms + 10) * 1_000_000
            assert stamps[-1] == (i + 1) * bundle_ms * 1_000_000
        assert simulator.simulated_s == pytest.approx(3 * bundle_ms / 1000)


def test_truth_is_never_in_the_readings() -> None:
    simulator = Simulator(CONFIG)
    projection = Projection(simulator.site)
    for _ in range(40):
        bundles = simulator.advance()
        state = simulator.state
        for i, readings in enumerate(bundles.values()):
            truths = np.concatenate([np.ravel(getattr(state, f.name)[i]) for f in fields(state)])
            truths = truths[(truths != 0) & (truths != np.round(truths))]
            for reading in readings:
                values = [getattr(reading, f.name) for f in fields(reading)[2:]]
                if isinstance(reading, Gps):
                    values += projection.to_map(reading.lat_deg, reading.lon_deg, reading.height_m)
                assert not set(values) & set(truths.tolist()), reading


@pytest.mark.slow
def test_ground_changes_when_the_scenario_says_so(tmp_path: Path) -> None:
    path = tmp_path / "rain.toml"
    path.write_text(
        'base = "paper_site"\nseconds = 3.0\n'
        '[[change]]\nat_s = 2.0\nsoil = "wet dirt"\noutline = [[0, 0], [200, 0], [200, 150], [0, 150]]\n'
        '[[change]]\nat_s = 1.0\nsoil = "sand"\noutline = [[0, 0], [200, 0], [200, 150], [0, 150]]\n'
    )
    for world in ("pybullet", "fast"):
        simulator = record(SimConfig(scenario=str(path), world=world), tmp_path / world, tmp_path / f"{world}-truth")
        track = simulator.tracks()["loader-1"]["c_rr"]
        np.testing.assert_allclose(track[[11, 18, 21, 28]], [0.25, 0.25, 0.06, 0.06])
        assert track[8] < 0.25
        maps = [
            TruthMap.load(tmp_path / f"{world}-truth" / f"truth_map{name}.npz")
            for name in ("_until_1s", "_until_2s", "")
        ]
        assert [m.c_rr.max() for m in maps] == pytest.approx([0.25, 0.25, 0.06])
        assert [m.c_rr.min() for m in maps] == pytest.approx([0.008, 0.25, 0.06])


def test_machines_start_apart_or_the_scenario_is_refused() -> None:
    with pytest.raises(ConfigError, match="no room for 150 machines"):
        Simulator(SimConfig(machines=150))


def test_tracks_are_the_true_ways_at_10_hz() -> None:
    simulator = Simulator(CONFIG)
    assert len(simulator.tracks()["loader-1"]) == 0
    for _ in range(40):
        simulator.advance()
    for i, track in enumerate(simulator.tracks().values()):
        assert np.diff(track["stamp_ns"]).tolist() == [100_000_000] * 19
        assert track["stamp_ns"][0] == START_NS + 100_000_000
        assert track["x"][-1] == simulator.state.x_m[i]
        assert track["mass"][-1] == simulator.state.mass_kg[i]
        moved = np.hypot(np.diff(track["x"]), np.diff(track["y"]))
        np.testing.assert_allclose(moved, 0.1 * track["speed"][1:], atol=0.02)
        assert (np.diff(track["work"], prepend=0.0) >= 0).all()  # brakes return nothing
        kinetic_j = track["mass"][-1] * track["speed"][-1] ** 2 / 2
        assert track["work"][-1] > kinetic_j > 0


def test_recording_holds_the_same_readings_and_the_truth(tmp_path: Path) -> None:
    simulator = record(CONFIG, tmp_path / "logs", tmp_path / "truth")
    with pytest.raises(ConfigError, match=r"logs: has a recording of .* already; choose another folder"):
        record(CONFIG, tmp_path / "logs")
    for machine in simulator.machines:
        log = open_log(tmp_path / "logs" / machine.name)
        assert log.machine == machine
        assert log.site == simulator.site
        assert list(log.readings()) == BASE[machine.name]  # in order, too
    truth = TruthMap.load(tmp_path / "truth" / "truth_map.npz")
    for f in fields(TruthMap):
        assert np.array_equal(getattr(truth, f.name), getattr(simulator.truth_map, f.name))
    lines = (tmp_path / "truth" / "tracks" / "loader-1.csv").read_text().splitlines()
    assert lines[0] == ",".join(TRACK_DTYPE.names)
    assert len(lines) == 17
    assert tuple(map(float, lines[-1].split(",")[1:])) == tuple(simulator.tracks()["loader-1"][-1].tolist()[1:])


def folder_bytes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("world", [pytest.param("pybullet", marks=pytest.mark.nightly), "fast"])
def test_same_seed_records_the_same_bytes_also_in_another_process(tmp_path: Path, world: str) -> None:
    config = changed(world=world, gps=(1, 2, 3), imu=(1, 2, 3, 4), attitude=(1, 3), seconds=3.0)
    record(config, tmp_path / "a", tmp_path / "a-truth")
    code = f"from pathlib import Path; from sim.config import SimConfig; from sim.recorder import record; {config!r}"
    code = code.replace("SimConfig(", "record(SimConfig(", 1) + ", Path('b'), Path('b-truth'))"
    path = {"PYTHONPATH": ":".join(p for p in sys.path if p)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=os.environ | path, capture_output=True)
    for name in ("", "-truth"):
        first, second = folder_bytes(tmp_path / f"a{name}"), folder_bytes(tmp_path / f"b{name}")
        assert first == second
        assert len(first) >= 4


def test_recording_stops_early_with_what_it_has_and_reports_progress(tmp_path: Path) -> None:
    stop, seen = threading.Event(), list[float]()

    def progress(simulated_s: float) -> None:
        seen.append(simulated_s)
        if simulated_s >= 0.5:
            stop.set()

    simulator = record(CONFIG, tmp_path, on_progress=progress, stop=stop)
    assert seen == pytest.approx(np.arange(1, 11) * 0.05)
    assert simulator.simulated_s == pytest.approx(0.5)
    last = max(r.stamp_ns for r in open_log(tmp_path / "loader-1").readings())
    assert last == START_NS + 500_000_000
