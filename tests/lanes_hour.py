"""Two half hours of a site that is drawn from nothing: is the second better, on the lanes that all drew?

python -m tests.lanes_hour: four machines, simulator and map server as processes. The server is killed a minute before
half time and is back a minute after. --map-aid off: the same drives without lanes.

Exit code 0 if the second half is better and nothing was lost, else 1.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from protocol.wire import keys
from protocol.wire.codec import decode_pose
from protocol.wire.messages import Pose
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sim.recorder import TRACKS_FOLDER
from sim.simulator import START_NS
from sitegrid.process.children import Children
from sitegrid.proof.figures import root_mean_square
from sitegrid.proof.tracks import read_track
from tests.integration.site_run import SiteRun, kill
from tests.patience import until

SETTLED_S, APART_S = 60.0, 60.0  # before errors count; of the server's end and return from half time
LAG_S = 90.0  # smoother lag, as agents have it
LOSSES = "bundles_missing", "lost", "double"


class Live:
    """A pose of each machine and second. newest_s: since the start, by machine."""

    def __init__(self) -> None:
        self.poses: dict[str, dict[int, Pose]] = {}
        self.newest_s: dict[str, float] = {}

    def note(self, sample: zenoh.Sample) -> None:
        """Keep a machine's pose."""
        pose = decode_pose(sample.payload.to_bytes())
        self.poses.setdefault(pose.machine, {})[pose.stamp_ns // 10**9] = pose
        self.newest_s[pose.machine] = (pose.stamp_ns - START_NS) * 1e-9

    def errors_m(self, truth: Path) -> dict[str, Callable[[float, float], float]]:
        """By machine its position RMSE between two times."""
        return {name: _rmse(list(poses.values()), truth / f"{name}.csv") for name, poses in self.poses.items()}


def _rmse(poses: list[Pose], track: Path) -> Callable[[float, float], float]:
    stamp_ns = np.array([pose.stamp_ns for pose in poses])
    off_m = np.hypot(*(np.array([(pose.x_m, pose.y_m) for pose in poses]) - read_track(track).at(stamp_ns)).T)
    at_s = (stamp_ns - START_NS) * 1e-9
    return lambda from_s, to_s: root_mean_square(off_m[(at_s >= from_s) & (at_s < to_s) & np.isfinite(off_m)])


def drive(folder: Path, sim: SimConfig, map_aid: str) -> dict[str, Any]:
    """Drive; returns errors by machine and half [m], bytes of lanes by machine, what was lost or double."""
    seconds = sim.seconds or 0.0
    live = Live()
    with Children(folder) as children:
        run = SiteRun(folder, children, free_endpoint(), sim, LAG_S)
        for config in run.configs:  # ends with [pipeline.localisation]
            config.write_text(f'{config.read_text(encoding="utf-8")}map_aid = "{map_aid}"\n', encoding="utf-8")
        run.start_router()
        server = run.start_server()
        run.start_agents()

        def reach(at_s: float) -> None:
            machines = live.newest_s
            until(lambda: machines and min(machines.values()) > at_s, "the drive", progress=machines.copy)

        with run.connect() as client:
            listener = client.session.declare_subscriber(keys.poses_all(run.site), live.note)
            run.start_sim("--scenario", sim.scenario, "--truth", folder / "truth")
            reach(seconds / 2 - APART_S)
            kill(server)
            reach(seconds / 2 + APART_S)
            run.start_server()
            reports = run.delivered(progress=live.newest_s.copy)
            listener.undeclare()  # type: ignore[no-untyped-call]
        run.server.stop()
    audit = run.audit()
    errors_m = live.errors_m(folder / "truth" / TRACKS_FOLDER)
    halves = ((SETTLED_S, seconds / 2), (seconds / 2, seconds))
    lanes = {name: report["lanes"] for name, report in reports.items()}
    return {
        "halves_m": {name: [round(rmse(*half), 3) for half in halves] for name, rmse in errors_m.items()},
        "lanes_bytes": {name: use["counters"].get("lanes_bytes", 0) if use else 0 for name, use in lanes.items()},
        "bundles_missing": sum(report["driver"].get("bundles_missing", 0) for report in reports.values()),
        "lost": audit.lost,
        "double": audit.double,
    }


def main() -> int:
    """Run, and print one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.lanes_hour", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the drive (default %(default)g)")
    parser.add_argument("--seed", type=int, default=3, help="default %(default)s")
    parser.add_argument("--speed", type=float, default=4.0, help="times real time (default %(default)g)")
    parser.add_argument("--map-aid", choices=("auto", "off"), default="auto", help="default %(default)s")
    arguments = parser.parse_args()
    pace = {"seconds": arguments.seconds, "speed": arguments.speed, "seed": arguments.seed}
    sim = SimConfig(scenario="paper_site_driven", machines=4, world="fast", **pace)
    with tempfile.TemporaryDirectory() as folder:
        figures = drive(Path(folder), sim, arguments.map_aid)
    first_m, second_m = map(root_mean_square, np.array(list(figures["halves_m"].values())).T)
    print(json.dumps(figures | {"all_m": [round(first_m, 3), round(second_m, 3)]}))
    return 0 if second_m < first_m and not any(figures[name] for name in LOSSES) else 1


if __name__ == "__main__":
    sys.exit(main())
