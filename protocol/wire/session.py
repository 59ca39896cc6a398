"""Zenoh sessions without scouting or shared memory, which can drop queries."""

import json
import os
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field

import zenoh

from protocol.errors import LinkError
from protocol.wire.credentials import Credentials

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_TLS_ENDPOINT = "tls/127.0.0.1:7447"
_SYSTEM_ERROR = re.compile(r"([^:\[\]()]+) \(os error \d+\)")
# Keeps one link from blocking a router:
ROUTER = {
    # Queue of a link that does not read [64 kB batches]: a whole piece of a region, so that it blocks no other.
    "transport/link/tx/queue/size/data": 16,
    # Beyond it the sender's other traffic stops until the link is closed [us]. Zenoh's 5 s exceed an agent's timeout.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    # Silent new links: with Zenoh's limits, 100 of them lock out others for 10 s.
    "transport/unicast/accept_pending": 500,  # of usually 1024 open files per process
    "transport/unicast/accept_timeout": 3000,  # [ms]: four small messages at 64 kbit/s
}
# Closing a stuck link blocks a kernel thread for 10 s (Zenoh sets SO_LINGER); with Zenoh's two threads, two such links
# would stop everything.
THREADS = "(rx: (worker_threads: 64), net: (worker_threads: 8))"


@dataclass(frozen=True)
class SessionConfig:
    """How a process joins the network.

    mode: "client", or "router", which listens. wait_s: for the router; negative opens at once and looks for it in the
    background. credentials: for mutual TLS, or None. guard: the router's rules as Zenoh settings.
    """

    endpoint: str = DEFAULT_ENDPOINT
    mode: str = "client"
    wait_s: float = 5.0
    credentials: Credentials | None = None
    guard: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.mode not in ("client", "router"):
            raise ValueError(f'mode: {self.mode!r} is neither "client" nor "router"')
        if "/" not in self.endpoint:
            raise ValueError(f"endpoint: {self.endpoint!r} is not like {DEFAULT_ENDPOINT}")
        if self.credentials and not self.endpoint.startswith("tls/"):
            raise ValueError(
                f"endpoint: {self.endpoint!r} proves no names; with keys it is like {DEFAULT_TLS_ENDPOINT}"
            )
        if not self.credentials and self.endpoint.startswith("tls/"):
            raise ValueError(f"endpoint: {self.endpoint!r} needs keys")


def open_session(config: SessionConfig) -> zenoh.Session:
    """Open a session; LinkError if router or listening address is unavailable in time."""
    settings = zenoh.Config()
    try:
        for key, value in _settings(config).items():
            settings.insert_json5(key, json.dumps(value))
        return zenoh.open(settings)
    except zenoh.ZError as error:
        raise LinkError(config.endpoint, f"cannot {_aim(config)} ({reason_of(error)})") from None


def reason_of(error: zenoh.ZError) -> str:
    """Zenoh's message without source locations and nested errors."""
    text = str(error).partition("\n")[0]
    if of_system := _SYSTEM_ERROR.search(text):
        return of_system[1].strip().lower()
    text = text.partition(" at /")[0]
    return "no answer in time" if text.endswith("Timeout!") else text[:120]


def _aim(config: SessionConfig) -> str:
    """What failed and why: a refused link looks like a missing one."""
    if config.mode == "router":
        return "listen here: end the router that does, or choose another --listen"
    if config.credentials:
        return (
            "reach a router here: start one with `sitegrid router --keys`, or it and these keys do not know each other"
        )
    return "reach a router here: start one with `sitegrid router`, or pass --keys if it asks for them"


def _settings(config: SessionConfig) -> dict[str, object]:
    settings: dict[str, object] = {
        "mode": config.mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    if config.credentials:
        settings["transport/link/tls"] = config.credentials.tls(listens=config.mode == "router")
    if config.mode == "router":
        return {**settings, **ROUTER, "listen/endpoints": [config.endpoint], **config.guard}
    # A client's open waits for the router; a peer that listens nowhere connects in the background.
    in_background = config.wait_s < 0
    wait_ms = -1 if in_background else int(config.wait_s * 1000)
    return settings | {
        "mode": "peer" if in_background else "client",
        "connect/endpoints": [config.endpoint],
        "connect/timeout_ms": wait_ms,
        "connect/exit_on_failure": not in_background,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "listen/endpoints": [],
    }


def use_many_threads() -> None:
    """Keep this process's links from blocking each other; before its first session."""
    os.environ.setdefault("ZENOH_RUNTIME", THREADS)


def free_endpoint() -> str:
    """A loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def is_free(port: int) -> bool:
    """Whether a loopback port is free."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
