"""`sitegrid trust` and `sitegrid distrust`: say whether a machine's samples are used."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from sitegrid.client import Client, connect
from sitegrid.process.lifetime import plain, say


def run(arguments: Namespace) -> int:
    """Give the command, wait until the map follows, print what is known of the machine then."""
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        row = _decide(client, arguments)
    if arguments.json:
        say(plain(row))
        return 0
    state = "is trusted" if row["trusted"] else "is left out of the map"
    print(f"{row['name']} {state}, as of journal row {row['merged']}")
    return 0


def _decide(client: Client, arguments: Namespace) -> dict[str, Any]:
    if not arguments.trusted:
        return client.distrust(arguments.machine, arguments.reason, wait_s=arguments.wait)
    if arguments.auto:
        return client.judge_automatically(arguments.machine, wait_s=arguments.wait)
    return client.trust(arguments.machine, wait_s=arguments.wait)
