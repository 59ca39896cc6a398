"""A misbehaving reader: `python -m tests.chaos.reader KIND ENDPOINT SITE`.

Written against the wire, to ask for more than the client would. Runs until killed.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import msgpack
import zenoh

from protocol.wire import keys
from protocol.wire.session import SessionConfig, open_session

LARGEST = "region?bounds=-2000,-2000,1999.5,1999.5"  # 16,000,000 cells: the documented limit
PIECE = "region?bounds=-128,-128,127.5,127.5;layers=visits,weight,age_s"  # the largest single answer
AT_ONCE = 20
WAITING = 300
BEFORE_SLEEP_S = 0.03  # for queries to leave

Ask = Callable[[str], "zenoh.Handler[zenoh.Reply]"]


def sleeping(ask: Ask) -> None:
    """Query the largest region concurrently, and some pieces; read nothing."""
    held = [ask(LARGEST), *(ask(PIECE) for _ in range(AT_ONCE))]
    time.sleep(BEFORE_SLEEP_S)
    os.kill(os.getpid(), signal.SIGSTOP)
    del held


def leaving(ask: Ask) -> None:
    """Query, and leave in mid-answer."""
    held = [ask(LARGEST), *(ask(PIECE) for _ in range(AT_ONCE))]
    time.sleep(BEFORE_SLEEP_S)
    os.kill(os.getpid(), signal.SIGKILL)
    del held


def looping(ask: Ask) -> None:
    """Query large regions and some of their pieces endlessly."""
    for attempt in itertools.count():
        for reply in ask(LARGEST):
            if reply.ok is not None and (piece := msgpack.unpackb(reply.ok.payload.to_bytes()).get("piece")):
                middle = piece["count"] // 2 + 18  # where machines drive
                for number in range(middle, middle + attempt % 5):
                    list(ask(f"piece?cursor={piece['cursor']};number={number}"))


def greedy(ask: Ask) -> None:
    """Query what reads the most known ground, sequentially."""
    zigzag = ",".join(f"{x},{y}" for n, y in enumerate(range(0, 1800, 60)) for x in ((0, 1790), (1790, 0))[n % 2])
    for query in itertools.cycle(
        (
            f"route?line={zigzag};step=1000;stops=none",
            "region?bounds=0,0,1799,1799;resolution=1000",
            "region?bounds=0,0,1799,1799;as_of=1767225700000000000;layers=resistance",
            "way?from=5,5;to=980,980",
            "worklist",
            "tiles",
        )
    ):
        list(ask(query))


def waiting(ask: Ask) -> None:
    """Wait for an impossible row as often as allowed, and query the past."""
    held = [ask("info?after=1000000000;wait=60") for _ in range(WAITING)]
    held += [ask(f"point?x=0;y=0;as_of={1_750_000_000_000_000_000 + n}") for n in range(AT_ONCE)]
    threading.Event().wait()
    del held


KINDS = {one.__name__: one for one in (sleeping, leaving, looping, greedy, waiting)}


def main(kind: str, endpoint: str, site: str) -> None:
    session = open_session(SessionConfig(endpoint))

    def ask(query: str) -> zenoh.Handler[zenoh.Reply]:
        name, _, parameters = query.partition("?")
        return session.get(f"{keys.map_query(site, name)}?{parameters}", timeout=60.0)

    KINDS[kind](ask)


if __name__ == "__main__":
    main(*sys.argv[1:])
