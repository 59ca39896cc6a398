import ast
import csv
import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents_drives import S_BEND, SITE, START_NS, Leg, changed_sensor, drive, machine, simulated

import agents
import protocol
from agents.pipeline import Pipeline, PipelineConfig
from protocol.logfolder import open_log
from protocol.machine import FRONT, MachineConfig, Mount, SensorConfig
from protocol.readings import KINDS, Encoder, Gps, Imu, Reading, columns
from protocol.samples import check_samples
from sim.config import SimConfig
from sim.recorder import record

SECOND = 10**9


@pytest.fixture(scope="module")
def recorded() -> list[Reading]:
    """A simulated drive of 40 s, with what happens on sites: a stop, outliers, a pause, a late reading.

    Half of the IMU's readings are enough here, and save time.
    """
    _, _, readings, _ = simulated(3, 40.0)
    return with_trouble([r for r in readings if not isinstance(r, Imu) or r.stamp_ns % 20_000_000 == 0])


def with_trouble(readings: list[Reading]) -> list[Reading]:
    """At 20 s the machine stands for 4 s; from 26 to 30 s fixes are 60 m off; at 32 s nothing is heard for 3 s."""
    stop_ns, pause_ns = START_NS + 20 * SECOND, START_NS + 28 * SECOND
    stand_ns, silent_ns = 4 * SECOND, 3 * SECOND
    found = [r for r in readings if r.stamp_ns <= stop_ns]
    last = {r.sensor: r for r in found}
    for i in range(1, stand_ns // (10 * 1_000_000)):
        stamp = stop_ns + i * 10_000_000
        still = Imu("imu-3", stamp, 0.001, 0.001, 0.003, 0.0, 0.0, 9.81)
        found += [still, *([replace(last["wheels"], stamp_ns=stamp)] if i % 5 == 0 else [])]
    for r in readings:
        if stop_ns < r.stamp_ns <= pause_ns:
            late = r.stamp_ns + stand_ns
            off = isinstance(r, Gps) and stop_ns + 2 * SECOND < r.stamp_ns < stop_ns + 6 * SECOND
            found.append(replace(r, stamp_ns=late, lat_deg=r.lat_deg + 6e-4) if off else replace(r, stamp_ns=late))
        elif r.stamp_ns > pause_ns + silent_ns:
            found.append(replace(r, stamp_ns=r.stamp_ns + stand_ns))
    late_fix = next(r for r in found if isinstance(r, Gps) and r.stamp_ns > START_NS + 17 * SECOND)
    behind = next(i for i, r in enumerate(found) if r.stamp_ns > late_fix.stamp_ns + 150_000_000)
    found.remove(late_fix)
    found.insert(behind, late_fix)
    return found


def run(of: MachineConfig, readings: list[Reading], config: PipelineConfig | None = None) -> tuple[bytes, Any]:
    """Samples, as bytes, and health."""
    pipeline = Pipeline(simulated(3, 40.0)[0], of, config or PipelineConfig())
    return pipeline.step(readings).tobytes(), pipeline.health()


@pytest.fixture(scope="module")
def of() -> MachineConfig:
    return simulated(3, 40.0)[1]


@pytest.fixture(scope="module")
def base(of: MachineConfig, recorded: list[Reading]) -> tuple[bytes, Any]:
    return run(of, recorded)


# --- what goes in and comes out --------------------------------------------------------------------------------------


def test_made_up_drive_gives_right_samples() -> None:
    of = machine()
    made = drive([*S_BEND, *S_BEND], of)
    rows = Pipeline(SITE, of, PipelineConfig()).step(made.readings)
    check_samples(rows, SITE.extent_m)
    settled = rows[40:]
    assert np.median(settled["c_rr"]) == pytest.approx(0.04, abs=0.004)
    assert np.abs(settled["grade_e"]).max() < 0.05
    ahead = [
        math.dist((r["x_m"] - 1.5 * math.cos(a[2]), r["y_m"] - 1.5 * math.sin(a[2])), a[:2])
        for r in settled
        for a in [made.at(int(r["stamp_ns"]))]
    ]
    assert max(ahead) < 0.6


def test_trouble_is_counted(base: tuple[bytes, Any]) -> None:
    samples, health = base
    assert len(samples) > 0
    assert health["aligned"]
    assert health["counters"]["gps-1_gated"] > 0
    assert health["counters"]["standstill_used"] > 0
    assert 0 < health["position_std_m"] < 5


def test_every_sample_is_plausible(of: MachineConfig, recorded: list[Reading]) -> None:
    rows = Pipeline(simulated(3, 40.0)[0], of, PipelineConfig()).step(recorded)
    check_samples(rows, 20_000)
    assert (np.diff(rows["stamp_ns"]) > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_any_cutting_of_the_stream_gives_the_same_samples(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pipeline = Pipeline(simulated(3, 40.0)[0], of, PipelineConfig())
    cuts = sorted(rng.choice(len(recorded), size=rng.integers(1, 2000)).tolist())
    made = [pipeline.step(recorded[a:b]) for a, b in zip([0, *cuts], [*cuts, len(recorded)], strict=True)]
    assert (np.concatenate(made).tobytes(), pipeline.health()) == base, f"seed={seed}"


def test_readings_of_unknown_sensors_are_counted_and_change_nothing(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any]
) -> None:
    strangers = [replace(recorded[100], sensor="stranger"), Encoder("imu-3", recorded[100].stamp_ns, 0.0, 0.0)]
    samples, health = run(of, [*recorded[:101], *strangers, *recorded[101:]])
    assert samples == base[0]
    assert health["counters"].pop("reading_unknown_sensor") == 2
    assert health == base[1]


def test_an_imu_without_accelerometer_invents_no_slope(of: MachineConfig, recorded: list[Reading]) -> None:
    """Its columns of force are filled with something: they must not reach the map as a grade."""
    sensors = tuple(replace(s, gives=("rate",)) if s.kind == "imu" else s for s in of.sensors)
    rows = Pipeline(simulated(3, 40.0)[0], replace(of, sensors=sensors), PipelineConfig()).step(recorded)
    assert len(rows) > 50
    assert np.isnan(rows["grade_e"]).all()
    assert np.isnan(rows["grade_n"]).all()


def test_doubled_readings_are_counted_and_change_nothing(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any]
) -> None:
    samples, health = run(of, [*recorded[:900], *recorded[850:]])
    assert samples == base[0]
    assert health["counters"]["reading_duplicate"] + health["counters"]["reading_late"] >= 50


def test_long_pause_starts_localisation_anew_and_keeps_the_counts() -> None:
    of = machine()
    made = drive([*S_BEND, Leg(8), *S_BEND[2:]], of)
    silent = (START_NS + 30 * SECOND, START_NS + 38 * SECOND)
    readings = [r for r in made.readings if not silent[0] < r.stamp_ns < silent[1]]
    pipeline = Pipeline(SITE, of, PipelineConfig())
    before = pipeline.step([r for r in readings if r.stamp_ns <= silent[0]])
    used = pipeline.health()["counters"]["gps-1_used"]
    first = pipeline.step([r for r in readings if r.stamp_ns >= silent[1]][:50])
    assert pipeline.pose is None
    assert not len(first)
    after = pipeline.step([r for r in readings if r.stamp_ns >= silent[1]][50:])
    assert len(before) > 80
    assert len(after) > 50
    assert int(after["stamp_ns"][0]) >= silent[1]
    counters = pipeline.health()["counters"]
    assert counters["gap_restarts"] == 1
    assert counters["gps-1_used"] > used


def test_machine_without_imu_or_torque_gives_samples_without_resistance_or_slope() -> None:
    of = machine()
    made = drive([Leg(4, 0.5), Leg(20)], of, without=("imu", "torque"))
    rows = Pipeline(SITE, of, PipelineConfig()).step(made.readings)
    check_samples(rows, SITE.extent_m)
    assert len(rows) > 50
    assert np.isnan(rows["c_rr"]).all()
    assert np.isnan(rows["grade_e"]).all()
    no_torque = Pipeline(SITE, of, PipelineConfig()).step(drive(S_BEND, of, without=("torque",)).readings)
    check_samples(no_torque, SITE.extent_m)
    assert np.isnan(no_torque["c_rr"]).all()
    assert np.isfinite(no_torque["grade_e"]).all()


def test_machine_that_aligns_late_loses_nothing_of_its_drive() -> None:
    """GPS comes up two minutes into the drive, longer than poses are remembered."""
    of = machine()
    made = drive([Leg(4, 0.5), *[Leg(10), Leg(5, 0, 0.3)] * 8, *S_BEND[1:]], of)
    readings = [r for r in made.readings if not isinstance(r, Gps) or r.stamp_ns > START_NS + 120 * SECOND]
    pipeline = Pipeline(SITE, of, PipelineConfig())
    rows = pipeline.step(readings)
    assert int(rows["stamp_ns"][0]) < START_NS + 5 * SECOND
    assert pipeline.health()["withheld"].get("no_pose", 0) <= 2


# --- never sees the truth --------------------------------------------------------------------------------------------


def test_samples_do_not_depend_on_the_truth(tmp_path: Path) -> None:
    """Two recordings of the same drive, one of them with its truth moved by 100 m."""
    config = SimConfig(world="fast", machines=1, seed=5, seconds=20.0)
    samples: list[bytes] = []
    for name in ("a", "b"):
        record(config, tmp_path / name / "logs", tmp_path / name / "truth")
        if name == "b":
            move_truth(tmp_path / name / "truth", 100.0)
        log = open_log(tmp_path / name / "logs" / "loader-1")
        samples.append(Pipeline(log.site, log.machine, PipelineConfig()).step(list(log.readings())).tobytes())
    tracks = [(tmp_path / n / "truth/tracks/loader-1.csv").read_bytes() for n in ("a", "b")]
    assert tracks[0] != tracks[1]
    assert samples[0] == samples[1]
    assert len(samples[0]) > 1000


def move_truth(folder: Path, by_m: float) -> None:
    for path in folder.rglob("*.csv"):
        with path.open(newline="") as text:
            rows = list(csv.DictReader(text))
        with path.open("w", newline="") as text:
            writer = csv.DictWriter(text, rows[0])
            writer.writeheader()
            writer.writerows({**row, "x": float(row["x"]) + by_m, "y": float(row["y"]) + by_m} for row in rows)


def imports(package: Any) -> Iterator[tuple[str, str]]:
    for path in Path(package.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((path.name, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, "relative imports are not used"
                yield path.name, node.module or ""


def test_no_module_of_agents_or_protocol_imports_the_simulator() -> None:
    found = [*imports(agents), *imports(protocol)]
    assert len(found) > 100
    forbidden = {"sim", "evaluation", "benchmarks", "mapserver", "sitegrid"}
    assert [(where, name) for where, name in found if name.split(".")[0] in forbidden] == []


def test_no_reading_carries_truth() -> None:
    names = {name for kind in KINDS for name in columns(kind)}
    assert not [n for n in names if "true" in n or "truth" in n]
    # what only the simulator knows, by name
    assert not names & {"x_m", "y_m", "yaw_rad", "heading_rad", "c_rr", "grade_e", "grade_n", "slip"}


# --- every option works ----------------------------------------------------------------------------------------------

# Options whose default does not matter on this drive need another value than twice the default.
VALUES: dict[str, Any] = {
    "gap_s": 2.0,  # the pause of 3 s restarts
    "late_s": 0.05,  # the late fix is refused
    "localisation.filter": "ekf",
    "localisation.profile": "paper",
    "localisation.start": (30.0, 20.0, 0.1),
    "localisation.motion.two_d": True,
    "localisation.sensing.gate_sigma": 1.0,
    "localisation.sensing.gps_gate_sigma": 1.0,
    "localisation.sensing.min_fix_std_m": 2.0,
    "localisation.fusion.relock": 1,
    "localisation.fusion.window_s": 0.02,
    "localisation.align_spread_m": 9.0,
    "localisation.align_way_m": 40.0,
    "estimation.stale_s": 0.01,  # torque comes every 20 ms
    "estimation.min_speed_mps": 2.5,
    "estimation.jump": 0.004,
    "sampling.max_std_m": 0.8,
    "sampling.max_pitch_rate_radps": 0.002,
}
# Tested on their own below.
ELSEWHERE = {"sampling.history_s", "localisation.sensing.turn_radps"}  # the latter in test_agents_turns.py


def options_of(config: Any, prefix: str = "") -> dict[str, Any]:
    """Every plain option of a nested dataclass, by dotted name, with its default."""
    found: dict[str, Any] = {}
    for f in fields(config):
        value = getattr(config, f.name)
        found |= (
            options_of(value, f"{prefix}{f.name}.")
            if hasattr(value, "__dataclass_fields__")
            else {f"{prefix}{f.name}": value}
        )
    return found


def changed(config: Any, dotted: str, value: Any) -> Any:
    head, _, rest = dotted.partition(".")
    return replace(config, **{head: changed(getattr(config, head), rest, value) if rest else value})


OPTIONS = options_of(PipelineConfig())


def test_every_table_of_options_is_covered() -> None:
    assert {name.rsplit(".", 1)[0] for name in OPTIONS if "." in name} == {
        "localisation",
        "localisation.motion",
        "localisation.sensing",
        "localisation.fusion",
        "estimation",
        "estimation.attitude",
        "sampling",
    }
    assert len(OPTIONS) > 35
    assert set(VALUES) | ELSEWHERE <= set(OPTIONS)


@pytest.mark.parametrize("name", sorted(set(OPTIONS) - ELSEWHERE))
def test_option_changes_samples_or_health(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any], name: str
) -> None:
    value = VALUES.get(name, type(OPTIONS[name])(2 * OPTIONS[name]))
    assert value != OPTIONS[name]
    assert run(of, recorded, changed(PipelineConfig(), name, value)) != base


def test_poses_are_remembered_for_history_s() -> None:
    of = machine()
    made = drive(S_BEND, of)
    for history_s, known in ((1.0, False), (30.0, True)):
        pipeline = Pipeline(SITE, of, changed(PipelineConfig(), "sampling.history_s", history_s))
        pipeline.step(made.readings)
        assert bool(pipeline.pose_at(START_NS + 20 * SECOND)) is known


@pytest.mark.parametrize(("name", "value"), [("gap_s", 0.0), ("late_s", -0.1)])
def test_bad_pipeline_option_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        PipelineConfig(**{name: value})


# --- every option of the machine and its sensors ---------------------------------------------------------------------

BODY = {
    "mass_kg": 20_000.0,
    "wheel_radius_m": 0.8,
    "load_centre_m": 0.5,
    "rotating_mass_factor": 1.2,
}
SENSOR = [
    ("gps-1", {"mount": Mount((5.0, 0.0, 3.35))}),
    ("gps-1", {"use": False}),
    ("gps-1", {"delay_s": 0.3}),
    ("gps-1", {"gate_sigma": 0.3}),
    ("imu-3", {"gate_sigma": 0.2}),
    ("wheels", {"gate_sigma": 0.2}),
    ("gps-1", {"drift_share": 0.1}),
    ("gps-1", {"drift_time_s": 10.0}),
    ("wheels", {"ticks_per_rev": 105}),
    ("wheels", {"use": False}),
    ("imu-3", {"mount": Mount((0.4, 0.0, 0.9), (0.0, 3.0, 0.0))}),
    ("imu-3", {"use": False}),
    ("imu-3", {"frame": FRONT}),
    ("imu-3", {"gives": ("rate",)}),
    ("torque", {"use": False}),
    ("gps-1", {"std": {"position": 5.0}}),
    ("imu-3", {"std": {"rate": 0.05}}),
    ("imu-3", {"std": {"force": 9.0}}),
    ("wheels", {"std": {"speed": 0.5}}),
    ("gps-2", {"mode": "differential"}),
    ("gps-2", {"mode": "relative"}),
]


def test_every_field_of_machine_and_sensor_is_covered() -> None:
    assert {f.name for f in fields(MachineConfig)} == {"name", "sensors", *BODY}
    covered = {name for _, options in SENSOR for name in options}
    assert {f.name for f in fields(SensorConfig)} == {"name", "kind", *covered}
    assert {f.name for f in fields(Mount)} == {"xyz_m", "rpy_deg"}


@pytest.mark.parametrize("name", sorted(BODY))
def test_option_of_the_body_changes_the_samples(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any], name: str
) -> None:
    assert run(replace(of, **{name: BODY[name]}), recorded)[0] != base[0]


@pytest.mark.parametrize(("sensor", "options"), SENSOR)
def test_option_of_a_sensor_changes_the_samples(
    of: MachineConfig, recorded: list[Reading], base: tuple[bytes, Any], sensor: str, options: dict[str, Any]
) -> None:
    assert run(changed_sensor(of, sensor, **options), recorded)[0] != base[0]


def test_sensor_that_is_not_used_is_as_if_it_were_not_there(of: MachineConfig, recorded: list[Reading]) -> None:
    unused = run(changed_sensor(of, "gps-2", use=False), recorded)
    without = replace(of, sensors=tuple(s for s in of.sensors if s.name != "gps-2"))
    assert unused[0] == run(without, [r for r in recorded if r.sensor != "gps-2"])[0]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"name": "No"}, "name"),
        ({"kind": "sonar"}, "kind"),
        ({"drift_share": 1.1}, "drift_share"),
        ({"drift_time_s": 0.0}, "drift_time_s"),
        ({"ticks_per_rev": 0}, "ticks_per_rev"),
    ],
)
def test_bad_sensor_option_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        SensorConfig(**{"name": "a", "kind": "gps", **options})


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"name": ""}, "name"),
        *(({name: 0.0}, name) for name in ("mass_kg", "wheel_radius_m")),
        ({"rotating_mass_factor": 0.9}, "rotating_mass_factor"),
        ({"sensors": (SensorConfig("a", "imu"), SensorConfig("a", "gps"))}, "sensors"),
    ],
)
def test_bad_machine_option_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        MachineConfig(**{"name": "a", **options})
