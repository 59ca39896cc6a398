"""`sitegrid init`: create site and machine files for the connected receivers."""

from __future__ import annotations

import math
import re
import shlex
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from protocol.errors import ConfigError, SitegridError
from protocol.wire.keys import check_name
from sitegrid.options.values import positive
from sitegrid.process.lifetime import note, say, tell

if TYPE_CHECKING:
    from sitegrid.setup.hearing import HeardLine

T = TypeVar("T")
HELP = "make a folder with the files of a site and a machine, for the receivers that are plugged in"
EXTRA = "receivers"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command; missing ones are asked for on a terminal."""
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="is made, where it is not there")
    ports = "where receivers are, as `sitegrid probe` has it (default: all serial ports)"
    add("--port", nargs="+", action="extend", default=[], dest="ports", metavar="PORT", help=ports)
    add("--site", metavar="NAME", help="name of the site (default: that of the folder)")
    add("--machine", metavar="NAME", help="name of the machine (default: its model, and -1)")
    add("--model", help="loader, truck, excavator (its carrier), roller or pickup")
    origin = "origin of the site; in the south --origin=-33.9,18.4 (default: the first fix)"
    add("--origin", type=parse_origin, metavar="LAT,LON[,HEIGHT]", help=origin)
    add("--seconds", type=positive, default=5.0, help="how long to listen (default %(default)s)")


def run(arguments: Namespace) -> int:
    """Listen, ask, write."""
    from sitegrid.setup import files
    from sitegrid.setup.hearing import block, missing

    folder = files.Folder(arguments.folder)
    if folder.agent_file.exists():
        raise ConfigError(folder.agent_file, "is there already, and stays as it is: edit it, or name another folder")
    every = _receivers(arguments)
    note("\n".join(line for heard in every for line in block(heard)))
    model = _answer(arguments.model, "--model", f"Kind of machine ({', '.join(files.models())})", "", _model)
    machine = _answer(arguments.machine, "--machine", "Name of the machine", f"{model}-1", _name)
    site, origin = "", tuple(0.0 for _ in files.ORIGIN)
    if folder.site_file.exists():
        note(f"{folder.site_file} is there, and kept as it is")
    else:
        site = _answer(arguments.site, "--site", "Name of the site", _as_name(folder.path), _name)
        no_fix = "No receiver has a fix. Place that is x = y = 0: LAT,LON[,HEIGHT]"
        origin = arguments.origin or files.origin_of(every) or _answer(None, "--origin", no_fix, "", parse_origin)
    written = files.write(folder, files.site_text(site, origin), files.agent_text(machine, model, every))
    lacks = missing(every)
    if arguments.json:
        say({"written": [str(path) for path in written], "missing": lacks})
        return 0
    tell(f"written: {', '.join(map(str, written))}", *lacks.values())
    tell(f"Measure what has a comment in {folder.agent_file}. Then: sitegrid doctor {shlex.quote(str(folder.path))}")
    return 0


def parse_origin(text: str) -> tuple[float, ...]:
    """Parse latitude, longitude [deg] and height [m]."""
    try:
        lat, lon, height = map(float, (text + ",0" if text.count(",") == 1 else text).split(","))
    except ValueError:
        lat = lon = height = math.nan
    if not math.isfinite(lat + lon + height):
        raise ArgumentTypeError(f"{text!r} is not LAT,LON[,HEIGHT] in degrees and metres, as 49.01,8.4,120")
    return lat, lon, height


def _model(text: str) -> str:
    from sitegrid.setup.files import models

    if text not in models():
        raise ConfigError("--model", f"{text!r} is none of {', '.join(models())}")
    return text


def _name(text: str) -> str:
    return check_name(text, "name")


def _as_name(folder: Path) -> str:
    """A valid site name from the folder's."""
    return re.sub("[^a-z0-9_-]+", "-", folder.absolute().name.lower()).strip("-_")[:63] or "site"


def _answer(given: str | None, option: str, question: str, default: str, parse: Callable[[str], T]) -> T:
    """The option, else an answer from the terminal, else the default; ConfigError without a terminal."""
    if given is not None:
        return parse(given)
    if not (sys.stdin and sys.stdin.isatty()):
        if not default:
            raise ConfigError(option, f"is missing: {question[0].lower()}{question[1:]}")
        return parse(default)
    while True:
        note(f"{question}{f' [{default}]' if default else ''}:")
        try:
            return parse(input().strip() or default)
        except EOFError:
            raise KeyboardInterrupt from None
        except (SitegridError, ArgumentTypeError) as error:
            note(str(error))


def _receivers(arguments: Namespace) -> list[HeardLine]:
    """Lines with a driver; ConfigError if there are none, or a named one has none."""
    from agents.drivers.transports import serial_ports
    from sitegrid.setup.hearing import NO_PORT
    from sitegrid.setup.listening import address_of, listen_to

    addresses = [address_of(port) for port in arguments.ports] or serial_ports()
    if not addresses:
        raise ConfigError("sitegrid init", NO_PORT)
    note(f"listening at {', '.join(addresses)}")
    every = listen_to(addresses, arguments.seconds)
    mute = [heard for heard in every if not heard.kind]
    if mute and (arguments.ports or len(mute) == len(every)):
        raise ConfigError(mute[0].address, mute[0].problem)
    return [heard for heard in every if heard.kind]
