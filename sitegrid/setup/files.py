"""Set-up files `site.toml` and `agent.toml` for what was heard, with measuring instructions per key.

They hold only what a user must state, and are parsed as by server and agent before writing.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from agents.config import AgentConfig, load_agent, require_place
from agents.drivers.formats import FIX, HEADING, IMU, STREAMS, VELOCITY, WHEELS
from agents.drivers.formats.framing import GPSD
from agents.drivers.receiver import BAUDS
from agents.drivers.tables import CAN
from protocol.config import toml_lines
from protocol.errors import ConfigError, SitegridError
from protocol.machine.machine_config import MachineConfig
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.wire.session import DEFAULT_ENDPOINT
from sitegrid.setup.hearing import HeardLine

PORTS = ROUTER, PAGE = int(DEFAULT_ENDPOINT.rpartition(":")[2]), 8080  # usual ports of router and page
MODELS = Path(__file__).with_name("models.toml")
ORIGIN = ("origin_lat_deg", "origin_lon_deg", "origin_height_m")
PLACES = (6, 6, 1)  # decimals of an origin: 0.1 m; its sameness matters more than its accuracy
NAMES = {FIX: "gps", VELOCITY: "doppler", HEADING: "compass", IMU: "imu", WHEELS: "wheels"}  # sensor names
# Measuring instructions for user-supplied values.
HOW = {
    "mass_kg": "empty, with driver and fuel: by a weighbridge, or its plate; only torque needs it",
    "wheel_radius_m": "by tape from the ground to the middle of a driven wheel, or of a track's sprocket",
    "wheelbase_m": "by tape from the middle of the rear axle to that of the front one, straight ahead",
    "load_centre_m": "where half of its weight is ahead, half behind: how far ahead of the rear axle",
    "skid_steers": "it turns by its two sides' speeds, as on tracks",
    "mount": "by tape: ahead, left, up of the point on the ground below the rear axle's middle [m]",
    "turned": "that too; rpy_deg: how its axes are turned from ahead, left, up [deg]",
    "heading": "of two antennas; [0, 0, 90] where the line from the first to the second points left [deg]",
    "ticks_per_rev": "turn a wheel once by hand, or drive ten turns, and count",
    "delay_s": "a receiver computes so long before it sends its fix, by which the time is set",
    "std": "gpsd's accuracies are no standard deviations: 2 m alone, 0.5 m with SBAS, 0.02 m with RTK fixed",
}


class Folder:
    """Files of a set-up: site, machine, store, spool, logs."""

    def __init__(self, path: Path) -> None:
        self.path, self.logs = path, path / "logs"
        self.site_file, self.agent_file, self.page_file = (path / f"{name}.toml" for name in ("site", "agent", "web"))
        self.store, self.spool = path / "store", path / "spool.db"

    def load(self) -> tuple[SiteConfig, MachineConfig, AgentConfig]:
        """Read both files like server and agent; ConfigError."""
        for path in (self.site_file, self.agent_file):
            if not path.exists():
                raise ConfigError(path, "no such file; `sitegrid init` makes it")
        site, (machine, config) = load_site(self.site_file), load_agent(self.agent_file)
        if machine is None:
            raise ConfigError(self.agent_file, "no [machine] is described; `sitegrid init` makes such a file")
        require_place(machine, config.pipeline.localisation)
        return site, machine, config


@cache
def models() -> dict[str, dict[str, Any]]:
    """Kinds of machines by name."""
    return tomllib.loads(MODELS.read_text(encoding="utf-8"))


def origin_of(every: Sequence[HeardLine]) -> tuple[float, ...]:
    """First place stated by a receiver: latitude, longitude, height; else empty."""
    place = next((heard.place for heard in every if heard.place), ())
    return tuple(round(value, n) for value, n in zip(place, PLACES, strict=False))


def site_text(name: str, origin: Sequence[float]) -> str:
    """A `site.toml`."""
    where = toml_lines(dict(zip(ORIGIN, origin, strict=True)))
    about = "# The site. All its machines and its map server must have this file, and the same origin for ever."
    origin_is = "# The place that is x = y = 0 on the map [deg, deg, m above the ellipsoid]; any near by will do."
    return "\n".join([about, *toml_lines({"name": name}), origin_is, *where]) + "\n"


def agent_text(name: str, model: str, every: Sequence[HeardLine]) -> str:
    """An `agent.toml` for a machine model with these receivers."""
    template = models()[model]
    lines = [f"# A machine, made by `sitegrid init` as a {model}: measure, and correct, what has a comment."]
    lines += ["", "[machine]", *toml_lines({"name": name}), *_explained(template["machine"])]
    for heard in (heard for heard in every if heard.kind == CAN):
        lines += ["", f"# {heard.address} is a bus with {', '.join(heard.streams)}: docs/can.md has its tables."]
    for i, heard in enumerate((heard for heard in every if heard.kind not in ("", CAN)), 1):
        feeds = {stream: f"{NAMES[stream]}-{i}" for stream in heard.streams}
        for stream, sensor in feeds.items():
            lines += ["", "[[sensor]]", *toml_lines({"name": sensor, "kind": STREAMS[stream]})]
            lines += _sensor_lines(stream, heard.kind, template)
        baud = {"baud": heard.baud} if heard.baud not in (0, BAUDS[0]) else {}
        lines += ["", "[[driver]]", *toml_lines({"kind": heard.kind, "address": heard.address, **baud})]
        lines.append(f"feeds = {_inline(feeds)}")
    return "\n".join(lines) + "\n"


def write(folder: Folder, site: str, agent: str) -> list[Path]:
    """Validate, then write missing files; returns them. ConfigError if one is invalid."""
    folder.path.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as trial:
        tried = Folder(Path(trial))
        is_there = folder.site_file.exists()
        tried.site_file.write_text(folder.site_file.read_text("utf-8") if is_there else site, encoding="utf-8")
        tried.agent_file.write_text(agent, encoding="utf-8")
        try:
            tried.load()
        except SitegridError as error:
            raise ConfigError(folder.path, str(error).replace(f"{trial}/", "")) from None
    texts = {} if is_there else {folder.site_file: site}
    for path, text in {**texts, folder.agent_file: agent}.items():
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    return [*texts, folder.agent_file]


def _sensor_lines(stream: str, kind: str, template: Mapping[str, Any]) -> Iterator[str]:
    if stream in (FIX, VELOCITY):
        how = HOW["mount"] if stream == FIX else "of the same antenna"
        yield f"mount = {{ xyz_m = {template['antenna_m']} }}  # {how}"
        if kind == GPSD:
            std = {"position": 2.0} if stream == FIX else {"velocity": 0.1}
            yield f"std = {_inline(std)}  # {HOW['std']}"
    elif stream == HEADING:
        yield 'measures = ["heading"]'
        yield "std = { heading = 0.01 }"
        yield f"mount = {{ rpy_deg = [0, 0, 0] }}  # {HOW['heading']}"
    elif stream == IMU:
        yield f"mount = {{ xyz_m = {template['imu_m']}, rpy_deg = [0, 0, 0] }}  # {HOW['turned']}"
    elif stream == WHEELS:
        yield f"ticks_per_rev = 100  # {HOW['ticks_per_rev']}"
    if stream in (IMU, WHEELS):
        yield f"delay_s = -0.05  # {HOW['delay_s']}"


def _explained(values: Mapping[str, Any]) -> list[str]:
    return [f"{line}  # {HOW[key]}" for key, line in zip(values, toml_lines(values), strict=True)]


def _inline(values: Mapping[str, Any]) -> str:
    return f"{{ {', '.join(toml_lines(values))} }}"
