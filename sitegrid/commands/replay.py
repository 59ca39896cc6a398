"""`sitegrid replay`: feed recorded readings to agents, or samples to a map server."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from itertools import chain
from pathlib import Path

from sitegrid.options.groups import add_network, add_site
from sitegrid.options.values import not_negative
from sitegrid.process.lifetime import note, say, stop_flag, tell

HELP = "replay recordings: feed agents with their readings, or a map server with their samples"
EXTRA = "record"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE.mcap", help="recordings, the oldest first")
    add_network(parser)
    add_site(parser)
    add("--machine", help="only what is of this machine")
    add("--samples", action="store_true", help="send samples to the map server; with --keys those of a machine")
    speed = "times the speed of the recording; 0: as fast as it is taken (default %(default)g)"
    add("--speed", type=not_negative, default=1.0, help=speed)


def run(arguments: Namespace) -> int:
    """Replay until the end, or until stopped."""
    from contextlib import closing

    from protocol.errors import ConfigError
    from protocol.machine.recorded_readings import readings_of
    from protocol.recording import RecordedFile
    from protocol.wire.session import open_session
    from sitegrid.record.replay import Agents, SampleSender, feed_agents, send_samples
    from sitegrid.security.join import join, signer

    stop = stop_flag()
    files = [RecordedFile(path) for path in arguments.files]
    named, only = arguments.files[0], arguments.machine
    role, name = ("machine", only or "") if arguments.samples else ("sim", "")
    config = join(arguments.endpoint, arguments.keys, role=role, name=name, site=arguments.site or "")
    identity = config.credentials.identity if config.credentials else None
    site = arguments.site or (identity.site if identity else "paper")
    if arguments.samples and identity:
        only = identity.name
    with closing(open_session(config)) as session:
        if arguments.samples:
            key = signer(arguments.keys)
            sender = SampleSender(session, config.endpoint, site, key.sign if key else None)
            said = chain.from_iterable(file.messages() for file in files)
            mine = (message for message in said if not only or message.topic.startswith(f"/machine/{only}/"))
            send_samples(mine, sender, arguments.speed, stop)
            table = {"samples": sender.sent, "had": sender.had}
        else:
            readings = chain.from_iterable(map(readings_of, files))
            with closing(Agents(session, config.endpoint, site, stop)) as agents:
                wanted = (reading for reading in readings if only in (None, reading.machine))
                feed_agents(wanted, agents, arguments.speed, stop)
            table = dict(agents.sent)
    for file in files:
        if file.is_cut:
            note(f"{file.path}: was interrupted while it was recorded; all before that is replayed")
    if not any(table.values()) and not stop.is_set():
        what = "samples" if arguments.samples else "readings"
        raise ConfigError(named, f"holds no {what}{f' of {only}' if only else ''}; see `sitegrid record --help`")
    say({"replayed": table}) if arguments.json else tell(
        f"replayed {', '.join(f'{n} of {k}' for k, n in table.items())}"
    )
    return 0
