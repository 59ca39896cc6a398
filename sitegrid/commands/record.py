"""`sitegrid record`: a running site's messages as a file for Foxglove, Rerun and `sitegrid replay`."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from pathlib import Path

from sitegrid.options.groups import add_network, add_site
from sitegrid.options.values import OutputFile, names, positive
from sitegrid.process.lifetime import note, say, stop_flag, tell

HELP = "record poses, health, readings, tiles and changes of a running site"
EXTRA = "record"
BESIDE = {"numba": "server", "scipy": "server"}  # for --store


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add("file", type=OutputFile((".mcap",)), metavar="FILE.mcap", help="file to write")
    add_network(parser)
    add_site(parser)
    what = "what is recorded, comma-separated: poses, health, readings (as published), tiles, changes (default: all)"
    add("--what", type=names, help=what)
    add("--store", type=Path, help="store of the map server on this host, of which new samples are recorded too")
    add("--duration", type=positive, default=float("inf"), metavar="S", help="seconds; without it until Ctrl-C")


def run(arguments: Namespace) -> int:
    """Record until stopped and report the contents."""
    from protocol.errors import ConfigError
    from protocol.recording import Recording
    from sitegrid.client import connect
    from sitegrid.record.recorder import WHAT, SiteRecorder

    if unknown := set(arguments.what or ()) - set(WHAT):
        raise ConfigError("--what", f"{min(unknown)} is none of {', '.join(WHAT)}")
    stop, samples = stop_flag(None), None  # completes the file at the end
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        client.site_info()
        if arguments.store:
            from sitegrid.record.samples import NewSamples

            samples = NewSamples(arguments.store)
        recording = Recording(arguments.file, {"site": client.site})
        try:
            recorder = SiteRecorder(client, recording, arguments.what or WHAT, samples, note)
            end_s = time.monotonic() + arguments.duration
            ready = {"ready": "record", "site": client.site, "file": str(recording.part)}
            say(ready) if arguments.json else note(f"{client.site} is recorded in {recording.part}; Ctrl-C ends it")
            recorder.run(lambda: stop.is_set() or time.monotonic() >= end_s)
            recording.finish()
        finally:
            recording.abandon()  # already closed without an error
    counts, lost = recorder.counts(), recorder.lost + Counter(excluded=recording.excluded)
    holds, lacks = (", ".join(f"{count} {name}" for name, count in some.items()) for some in (counts, lost))
    table = {"recorded": str(arguments.file), "messages": counts, "lost": lost}
    say(table) if arguments.json else tell(f"{arguments.file}: {holds}" + (f"; {lacks}" if lacks else ""))
    return 0
