"""`sitegrid router`: a Zenoh session in router mode is a full site router (EVIDENCE, Zenoh)."""

from __future__ import annotations

from argparse import Namespace

from protocol.session import SessionConfig, open_session
from sitegrid.process import say, stop_flag, wait


def run(arguments: Namespace) -> int:
    """Route until stopped."""
    stop = stop_flag()
    session = open_session(SessionConfig(arguments.listen, mode="router"))
    say({"ready": "router", "endpoint": arguments.listen})
    wait(stop)
    session.close()  # type: ignore[no-untyped-call]
    return 0
