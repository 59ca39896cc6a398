"""The demo's run: start everything, wait for the end, audit samples, draw pictures."""

from __future__ import annotations

import sys
import threading
import time
from argparse import Namespace
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from agents.localisation.localiser import LocalisationConfig
from mapserver.config import ServerConfig
from mapserver.pictures.plotter import side_by_side, write_image
from protocol.errors import ConfigError, LinkError, QueryError
from protocol.queries.answers import Region
from protocol.queries.parameters import MAX_WAIT_S
from protocol.site.site_file import load_site
from sim.recorder import TRACKS_FOLDER
from sim.truth import TruthMap
from sitegrid.client import Client, connect
from sitegrid.demo.plan import READY_S, DemoPlan, LogReplay, make_plan, start_agent, start_server, start_sim, start_web
from sitegrid.pictures.draw import TrackRecorder, draw, draw_both, draw_differences, truth_layers
from sitegrid.process.children import Child, Children
from sitegrid.process.lifetime import note, plain, say, tell, wait
from sitegrid.process.progress import Display
from sitegrid.proof.delivery import AuditResult, audit_store
from sitegrid.proof.map_score import DrivenScore, MapScore, score, score_driven
from sitegrid.proof.tracks import position_rmse, read_load_track

SAMPLES_FOLLOW = f"the map starts to fill after {LocalisationConfig().lag_s:g} s"  # the smoother's lag, in site time


def run(arguments: Namespace, stop: threading.Event, display: Display) -> int:
    """Run the demo; returns 1 on lost or doubled samples or a failed child."""
    began_s = time.monotonic()
    plan = make_plan(arguments)
    if not arguments.json:
        note("A site on this host: router, map server, page, simulator, and an agent per machine, each its own process")
    display.begin("router and page start")

    def meanwhile(line: dict[str, Any]) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        if "note" in line:
            display.begin("server starts", line["note"])

    try:
        with Children(plan.work, meanwhile) as children:
            with display:
                children.start("router", "router", "--listen", plan.endpoint).expect("ready", READY_S)
                url = start_web(plan, children) if arguments.web or arguments.stay else ""
                if url:
                    note(f"the map is at {url}")
                result = _drive(plan, children, stop, display)
                if stays(arguments):
                    start_server(plan, children, "server", plan.site_file).expect("ready", READY_S)
                result["wall_s"] = round(time.monotonic() - began_s, 1)
            say(plain(result)) if arguments.json else _print(result)
            if stays(arguments):
                note(f"the map stays at {url} until Ctrl-C; another terminal can ask it:")
                note(f"  {sys.argv[0]} query --endpoint {plan.endpoint} --site {plan.scenario.site.name} machines")
                wait(stop)
    except KeyboardInterrupt:
        note("stopped; everything is ended")
        raise
    return 0 if result["lost"] == result["double"] == 0 else 1


def stays(arguments: Namespace) -> bool:
    """Whether the page stays open at the end: by option, or on a terminal, which has Ctrl-C."""
    return arguments.stay or (arguments.web and not arguments.json and sys.stderr.isatty())


def _drive(plan: DemoPlan, children: Children, stop: threading.Event, display: Display) -> dict[str, Any]:
    display.begin("server starts")
    server = start_server(plan, children, "server", plan.site_file)
    agents = {path.stem: start_agent(plan, children, path) for path in plan.configs}
    server.expect("ready", READY_S)
    log_replay = LogReplay(plan, plan.log, children) if plan.log else None
    for child in agents.values():
        child.expect("ready", READY_S)
    sim = start_sim(plan, children)
    with connect(plan.endpoint, plan.scenario.site.name) as client:
        tracks = TrackRecorder(client.session, plan.scenario.site.name)
        _watch(plan, client, tracks, (sim, agents), (stop, display))
        display.begin("pictures are drawn, and every sample is accounted for")
        for child in agents.values():
            child.expect("ended", READY_S)
        client.calibrate(wait_s=MAX_WAIT_S)  # include the last samples
        region, pictures = _draw(plan, client, tracks)
        rmse_m = position_rmse(tracks.poses(), plan.truth)
        tracks.close()
    log_report = log_replay.finish(plan) if log_replay else None
    server.stop()
    audits = {name: plan.work / f"{name}.audit" for name in agents}
    audit = audit_store(audits, plan.work / "store", load_site(plan.site_file), ServerConfig())
    truth = truth_layers(TruthMap.load(plan.true_map), region)
    machines = [rig.machine for rig in plan.scenario.rigs()]
    folder = plan.truth / TRACKS_FOLDER
    driven = [read_load_track(folder / f"{m.name}.csv", m.load_centre_m).place_m for m in machines]
    scores = score(region, truth), score_driven(region, truth, driven)
    return _report(plan, audit, scores, rmse_m, pictures, log_report)


def _watch(
    plan: DemoPlan,
    client: Client,
    tracks: TrackRecorder,
    children: tuple[Child, dict[str, Child]],
    control: tuple[threading.Event, Display],
) -> None:
    """Show progress and the map until the machines stop; KeyboardInterrupt if stopped."""
    (sim, agents), (stop, display) = children, control
    simulated_s, next_picture_s = 0.0, time.monotonic() + 3
    display.begin("machines drive")
    while sim.code is None or (not sim.code and any(agent.code is None for agent in agents.values())):
        if stop.wait(0.25):
            raise KeyboardInterrupt
        for line in sim.lines():
            simulated_s = line.get("simulated_s", simulated_s)
        display.show(simulated_s, plan.scenario.seconds, _what(client))
        if time.monotonic() >= next_picture_s:
            with suppress(LinkError, QueryError):  # drawn again shortly: a busy host does not end the demo
                draw(client, plan.out / "map.png", _whole(plan), tracks.tracks(), empty=SAMPLES_FOLLOW)
            next_picture_s = time.monotonic() + 3
    if sim.code:
        raise ConfigError("sitegrid demo", f"the simulator ended with {sim.code}; see {plan.work / 'sim.log'}")


def _what(client: Client) -> str:
    try:
        info = client.info()
    except (LinkError, QueryError):  # shown again shortly
        return "the map server is away"
    return f"{info.samples_merged} samples, {info.cells} cells" if info.samples_merged else SAMPLES_FOLLOW


def _whole(plan: DemoPlan) -> list[float]:
    if not plan.true_map.exists():
        return [0.0, 0.0, plan.scenario.ground.width_m, plan.scenario.ground.depth_m]
    true = TruthMap.load(plan.true_map)
    rows, columns = true.c_rr.shape
    return [true.west_m, true.south_m, true.west_m + columns * true.cell_m, true.south_m + rows * true.cell_m]


def _draw(plan: DemoPlan, client: Client, tracks: TrackRecorder) -> tuple[Region, list[str]]:
    """Write the final pictures; returns the map and their files."""
    region = client.region(tuple(_whole(plan)))  # type: ignore[arg-type]
    pictures = {
        "map.png": draw_both(region, tracks.tracks(), machines=client.machines()),
        "difference.png": draw_differences(region, plan.true_map),
    }
    for name, images in pictures.items():
        write_image(plan.out / name, side_by_side(images))
    return region, [str(plan.out / name) for name in pictures]


def _report(
    plan: DemoPlan,
    audit: AuditResult,
    scores: tuple[MapScore, DrivenScore],
    rmse_m: dict[str, float],
    pictures: list[str],
    log: dict[str, Any] | None,
) -> dict[str, Any]:
    """The report. rmse_m: position error by machine. log: the replayed log's."""
    whole, driven = scores
    log_lost, log_double = (log["lost"], log["double"]) if log else (0, 0)
    return {
        "machines": len(plan.configs),
        "seconds": plan.scenario.seconds,
        "seed": plan.scenario.seed,
        "samples_recorded": audit.recorded,
        "samples_merged": audit.merged,
        "lost": audit.lost + log_lost,
        "double": audit.double + log_double,
        "unrecorded": audit.unrecorded,
        "cells": whole.cells,
        "wrong_resistance_pct": round(whole.wrong_resistance_pct, 2),
        "wrong_grade_pct": round(whole.wrong_grade_pct, 2),
        "driven": {name: round(v, 2) if isinstance(v, float) else v for name, v in asdict(driven).items()},
        "position_rmse_m": {name: round(value, 2) for name, value in rmse_m.items()},
        "pictures": [*pictures, *([log["picture"]] if log else [])],
        "log": log,
    }


def _print(result: dict[str, Any]) -> None:
    """The report for people."""
    r, driven = result, result["driven"]
    rmse = ", ".join(f"{name} {value} m" for name, value in r["position_rmse_m"].items())
    tell(
        f"{r['machines']} machines drove {r['seconds']:g} s, recorded {r['samples_recorded']} samples;\n"
        f"  merged {r['samples_merged']}, lost {r['lost']}, double {r['double']}\n"
        f"  {r['cells']} cells are known: resistance class wrong in {r['wrong_resistance_pct']} %, "
        f"slope class in {r['wrong_grade_pct']} %\n"
        f"  {driven['cells']} cells were truly driven: {driven['known_pct']} % are known, of these "
        f"{driven['wrong_resistance_pct']} % wrong by resistance, {driven['wrong_grade_pct']} % by slope\n"
        f"  position error (rms): {rmse}"
    )
    if log := result["log"]:
        withheld = f"{log['withheld_rms_m']} m rms against {log['withheld_fixes']} withheld fixes"
        tell(f"real log {log['name']}: {log['recorded']} samples, lost {log['lost']}, {withheld}")
    tell("pictures:", *(f"  {picture}" for picture in result["pictures"]))
