"""The run of the demo: start every part, wait for the end, audit the samples, draw the pictures."""

from __future__ import annotations

import dataclasses
import shutil
import threading
import time
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evaluation.audit import AuditResult, audit_store
from evaluation.ground.truth import read_way
from evaluation.maps.score import DrivenScore, MapScore, score, score_driven
from evaluation.positions.live_error import position_rmse
from mapserver.config import ServerConfig
from mapserver.pictures.plotter import draw_difference, side_by_side, write_image
from protocol.errors import ConfigError, LinkError, QueryError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.queries.answers import Region
from protocol.site.site_config import load_site
from protocol.wire.session import free_endpoint
from sim.config import SimConfig, resolve
from sim.recorder import TRACKS_FOLDER
from sim.scenario.tables import Scenario
from sim.truth import TruthMap
from sitegrid.client import Client, connect
from sitegrid.commands.sim import write_configs
from sitegrid.pictures.draw import draw, draw_both
from sitegrid.pictures.tracks import TrackRecorder
from sitegrid.pictures.truth_layers import truth_layers
from sitegrid.process.children import Child, Children, wait_until
from sitegrid.process.lifetime import note, plain, say, stop_flag
from sitegrid.process.progress import Display

DEFAULT_MANIFEST = Path("evaluation/logs/rl_test1_husky/log.toml")
DEFAULT_DATA = Path("../shared/data/rl_test1_husky")
LOG_SPEED = 20.0
READY_S = 30.0


@dataclass(frozen=True)
class Plan:
    """Where everything of one run lies."""

    out: Path
    work: Path
    endpoint: str
    config: SimConfig
    scenario: Scenario
    configs: list[Path]
    log: LogFolder | None
    manifest: Path | None

    def site_file(self) -> Path:
        """The simulated site."""
        return self.work / "site.toml"


def run(arguments: Namespace) -> int:
    """Run the demo; returns 1 if a sample was lost or counted twice, or a child failed."""
    stop = stop_flag(None)  # it has children to end
    began_s = time.monotonic()
    plan = _plan(arguments)
    with Children(plan.work) as children:
        result = _drive(plan, children, stop, Display("machines drive", headless=arguments.headless or arguments.json))
    if result is None:
        note("stopped; everything is ended")
        return 130
    result["wall_s"] = round(time.monotonic() - began_s, 1)
    say(plain(result)) if arguments.json else _print(result)
    return 0 if result["lost"] == result["double"] == 0 else 1


def _plan(arguments: Namespace) -> Plan:
    try:
        config = SimConfig(
            scenario=arguments.scenario,
            world=arguments.world,
            machines=arguments.machines,
            seed=arguments.seed,
            seconds=arguments.seconds,
            speed=arguments.speed,
        )
    except ValueError as error:
        raise ConfigError("sitegrid demo", str(error)) from None
    scenario = resolve(config)
    work = arguments.out / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    manifest, data = _log_of(arguments)
    log = open_log(manifest, data) if manifest else None
    return Plan(arguments.out, work, free_endpoint(), config, scenario, write_configs(config, work), log, manifest)


def _log_of(arguments: Namespace) -> tuple[Path | None, Path | None]:
    """The log to replay: as asked for, or the default one where its data lies."""
    if arguments.no_log:
        return None, None
    if arguments.log:
        return arguments.log, arguments.data
    if DEFAULT_MANIFEST.exists() and DEFAULT_DATA.exists():
        return DEFAULT_MANIFEST, DEFAULT_DATA
    return None, None


# --- the run ---------------------------------------------------------------------------------------------------------


def _drive(plan: Plan, children: Children, stop: threading.Event, display: Display) -> dict[str, Any] | None:
    """Start everything, wait for the end, judge and draw; None if stopped on the way."""
    children.start("router", "router", "--listen", plan.endpoint).expect("ready", READY_S)
    server = _start_server(plan, children, "server", plan.site_file())
    agents = {path.stem: _start_agent(plan, children, path) for path in plan.configs}
    log_run = _LogRun(plan, plan.log, children) if plan.log else None
    for child in agents.values():
        child.expect("ready", READY_S)
    sim = _start_sim(plan, children)
    with connect(plan.endpoint, plan.scenario.site.name) as client:
        tracks = TrackRecorder(client.session, plan.scenario.site.name)
        with display:
            if not _watch(plan, client, tracks, (sim, agents), (stop, display)):
                return None
        reports = {name: child.expect("ended", READY_S)["ended"] for name, child in agents.items()}
        region, pictures = _draw(plan, client, tracks)
        rmse = position_rmse(tracks.poses(), plan.work / "truth")
        tracks.close()
    log_report = log_run.finish(plan) if log_run else None
    server.stop()
    audits = {name: plan.work / f"{name}.audit" for name in agents}
    audit = audit_store(audits, plan.work / "store", load_site(plan.site_file()), ServerConfig())
    truth = truth_layers(TruthMap.load(_truth_file(plan)), region)
    machines = [rig.machine for rig in plan.scenario.rigs()]
    tracks_folder = plan.work / "truth" / TRACKS_FOLDER
    ways_m = [read_way(tracks_folder / f"{m.name}.csv", m.load_centre_m).place_m for m in machines]
    scores = score(region, truth), score_driven(region, truth, ways_m)
    return _result(plan, (audit, scores, rmse), reports, pictures, log_report)


def _start_server(plan: Plan, children: Children, name: str, site_file: Path) -> Child:
    store = plan.work / ("store" if name == "server" else f"store-{name}")
    words = ("server", "--endpoint", plan.endpoint, "--site-file", site_file, "--store", store)
    child = children.start(name, *words)
    child.expect("ready", READY_S)
    return child


def _start_agent(plan: Plan, children: Children, config: Path) -> Child:
    name = config.stem
    files = ("--spool", plan.work / f"{name}.db", "--audit", plan.work / f"{name}.audit")
    base = ("agent", "--endpoint", plan.endpoint, "--site-file", plan.site_file(), "--config", config)
    return children.start(name, *base, *files, "--json")


def _start_sim(plan: Plan, children: Children) -> Child:
    c = plan.config
    options = {name: getattr(c, name) for name in ("scenario", "world", "machines", "seed", "seconds", "speed")}
    words = [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]
    return children.start("sim", "sim", "--endpoint", plan.endpoint, *words, "--truth", plan.work / "truth", "--json")


def _watch(
    plan: Plan,
    client: Client,
    tracks: TrackRecorder,
    children: tuple[Child, dict[str, Child]],
    control: tuple[threading.Event, Display],
) -> bool:
    """Show progress and redraw the map until the machines have driven; False if stopped."""
    (sim, agents), (stop, display) = children, control
    simulated_s, next_picture_s = 0.0, time.monotonic() + 3
    while sim.code is None or any(agent.code is None for agent in agents.values()):
        if stop.wait(0.25):
            return False
        for line in sim.lines():
            simulated_s = line.get("simulated_s", simulated_s)
        display.show(simulated_s, plan.scenario.seconds, _what(client))
        if time.monotonic() >= next_picture_s:
            draw(client, plan.out / "map.png", _whole(plan), tracks.tracks())
            next_picture_s = time.monotonic() + 3
    if sim.code:
        raise ConfigError("sitegrid demo", f"the simulator ended with {sim.code}; see {plan.work / 'sim.log'}")
    return True


def _what(client: Client) -> str:
    try:
        info = client.info()
    except (LinkError, QueryError):  # shown again in a moment
        return "the map server is away"
    return f"{info.samples_merged} samples, {info.cells} cells"


def _whole(plan: Plan) -> list[float]:
    truth = _truth_file(plan)
    if not truth.exists():
        return [0.0, 0.0, plan.scenario.ground.width_m, plan.scenario.ground.depth_m]
    true = TruthMap.load(truth)
    rows, columns = true.c_rr.shape
    return [true.west_m, true.south_m, true.west_m + columns * true.cell_m, true.south_m + rows * true.cell_m]


def _truth_file(plan: Plan) -> Path:
    return plan.work / "truth" / "truth_map.npz"


def _draw(plan: Plan, client: Client, tracks: TrackRecorder) -> tuple[Region, list[str]]:
    """Write the final pictures; returns the map and their files."""
    region = client.region(tuple(_whole(plan)))  # type: ignore[arg-type]
    truth = truth_layers(TruthMap.load(_truth_file(plan)), region)
    lines = tracks.tracks()
    pictures = {
        "map.png": draw_both(region, lines),
        "difference.png": [draw_difference(region, truth, "resistance"), draw_difference(region, truth, "grade")],
    }
    for name, images in pictures.items():
        write_image(plan.out / name, side_by_side(images))
    return region, [str(plan.out / name) for name in pictures]


class _LogRun:
    """A real log, replayed by an agent of its own into a site with a map server of its own."""

    def __init__(self, plan: Plan, log: LogFolder, children: Children) -> None:
        assert plan.manifest is not None
        self._site = log.site
        self._machine = log.machine.name
        self._server = _start_server(plan, children, "log-server", plan.manifest)
        self._client = connect(plan.endpoint, log.site.name)
        self._tracks = TrackRecorder(self._client.session, log.site.name)
        files = ("--spool", plan.work / "log.db", "--audit", plan.work / "log.audit")
        source = ("--driver", "replay", "--log", plan.manifest, "--data", log.data, "--speed", LOG_SPEED)
        words = ("agent", "--endpoint", plan.endpoint, *source, *files, "--withhold", "--json")
        self._agent = children.start("log-agent", *words)

    def finish(self, plan: Plan) -> dict[str, Any]:
        """Wait for the agent, draw its map, compare with its audit file."""
        report = self._agent.expect("ended", 300.0)["ended"]
        wait_until(lambda: self._client.info().merged == self._client.info().journalled, READY_S, "log-server")
        picture = plan.out / "log-map.png"
        draw(self._client, picture, None, self._tracks.tracks())
        self._tracks.close()
        self._client.close()
        self._server.stop()
        audits = {self._machine: plan.work / "log.audit"}
        audit = audit_store(audits, plan.work / "store-log-server", self._site, ServerConfig())
        withheld = {f"withheld_{key}": value for key, value in report["holdout"].items()}
        return {"name": self._machine, **dataclasses.asdict(audit), **withheld, "picture": str(picture)}


# --- what came out ---------------------------------------------------------------------------------------------------


def _result(
    plan: Plan,
    judged: tuple[AuditResult, tuple[MapScore, DrivenScore], dict[str, float]],
    reports: dict[str, Any],
    pictures: list[str],
    log: dict[str, Any] | None,
) -> dict[str, Any]:
    audit, (found, driven), rmse = judged
    log_lost, log_double = (log["lost"], log["double"]) if log else (0, 0)
    return {
        "machines": len(reports),
        "seconds": plan.scenario.seconds,
        "seed": plan.scenario.seed,
        "samples_recorded": audit.recorded,
        "samples_merged": audit.merged,
        "lost": audit.lost + log_lost,
        "double": audit.double + log_double,
        "unrecorded": audit.unrecorded,
        "cells": found.cells,
        "wrong_resistance_pct": round(found.wrong_resistance_pct, 2),
        "wrong_grade_pct": round(found.wrong_grade_pct, 2),
        "driven": {
            "cells": driven.cells,
            "known_pct": round(driven.known_pct, 2),
            "wrong_resistance_pct": round(driven.wrong_resistance_pct, 2),
            "wrong_grade_pct": round(driven.wrong_grade_pct, 2),
            "by_border": driven.by_border,
        },
        "position_rmse_m": {name: round(value, 2) for name, value in rmse.items()},
        "pictures": [*pictures, *([log["picture"]] if log else [])],
        "log": log,
    }


def _print(result: dict[str, Any]) -> None:
    print(
        f"{result['machines']} machines drove {result['seconds']:g} s, recorded {result['samples_recorded']} samples;"
    )
    print(f"  merged {result['samples_merged']}, lost {result['lost']}, double {result['double']}")
    wrong = (
        f"resistance class wrong in {result['wrong_resistance_pct']} %, slope class in {result['wrong_grade_pct']} %"
    )
    print(f"  {result['cells']} cells are known: {wrong}")
    driven = result["driven"]
    print(
        f"  {driven['cells']} cells were truly driven: {driven['known_pct']} % are known, of these "
        f"{driven['wrong_resistance_pct']} % wrong by resistance, {driven['wrong_grade_pct']} % by slope"
    )
    rmse = ", ".join(f"{name} {value} m" for name, value in result["position_rmse_m"].items())
    print(f"  position error (rms): {rmse}")
    if log := result["log"]:
        withheld = f"{log['withheld_rms_m']} m rms against {log['withheld_fixes']} withheld fixes"
        print(f"real log {log['name']}: {log['recorded']} samples, lost {log['lost']}, {withheld}")
    print("pictures:", *result["pictures"], sep="\n  ")
