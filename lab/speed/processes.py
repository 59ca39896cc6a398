"""Real processes on loopback, for benchmarks from outside: router, map server, and a service that answers at once.

The latter is this module, `python -m lab.speed.processes ENDPOINT`: it replies with as many bytes as it is asked for.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import zenoh

from protocol.config import toml_lines
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session

EMPTY_KEY = "bench/empty"
OPTIONS = "[store]\narchive_after_h = 0.0\n"  # samples of a benchmark are older than what a server keeps in its journal
END_S, ANSWER_S = 30.0, 120.0
SETTLED_CORES, SETTLE_S = 0.1, 300.0  # a server that has just come looks for changes everywhere


@contextmanager
def process(*words: str) -> Iterator[int]:
    """Run `python -m words` until left; gives its process id once it says that it is ready."""
    command, root = [sys.executable, "-m", *words], Path(__file__).parent.parent
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stdin=subprocess.PIPE) as child:  # noqa: S603
        try:
            if child.stdout is None or "ready" not in json.loads(child.stdout.readline() or "{}"):
                raise RuntimeError(f"{' '.join(words[:2])} did not start: nothing was measured")
            yield child.pid
        finally:
            child.terminate()
            try:
                child.communicate(timeout=END_S)
            except subprocess.TimeoutExpired:
                child.kill()


@contextmanager
def routed() -> Iterator[tuple[str, int]]:
    """A router; gives its endpoint and its process id."""
    endpoint = free_endpoint()
    with process("sitegrid.cli", "router", "--listen", endpoint) as pid:
        yield endpoint, pid


@contextmanager
def serving(endpoint: str, folder: Path, site: SiteConfig, options: str = OPTIONS) -> Iterator[int]:
    """A map server with a store in the folder, at a router; gives its process id.

    options: of its configuration file.
    """
    site_file, config = folder / "site.toml", folder / "server.toml"
    site_file.write_text("\n".join(toml_lines(asdict(site))))
    config.write_text(options)
    where = ("--endpoint", endpoint, "--site-file", str(site_file), "--store", str(folder), "--config", str(config))
    with process("sitegrid.cli", "server", *where) as pid:
        yield pid


@contextmanager
def served(folder: Path, site: SiteConfig, options: str = OPTIONS) -> Iterator[tuple[str, int]]:
    """Both; gives the router's endpoint and the server's process id."""
    with routed() as (endpoint, _), serving(endpoint, folder, site, options) as pid:
        yield endpoint, pid


@contextmanager
def session(endpoint: str) -> Iterator[zenoh.Session]:
    """A session with the router."""
    opened = open_session(SessionConfig(endpoint))
    try:
        yield opened
    finally:
        opened.close()  # type: ignore[no-untyped-call]


def ask(link: zenoh.Session, selector: str, payload: bytes | None = None) -> list[bytes]:
    """All replies to a query."""
    replies = list(link.get(selector, payload=payload, timeout=ANSWER_S))
    if not replies or any(reply.ok is None for reply in replies):
        problems = [reply.err.payload.to_bytes() for reply in replies if reply.err is not None]
        raise RuntimeError(f"{selector}: {problems or 'no answer'}")
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def send(link: zenoh.Session, site: SiteConfig, batch: SampleBatch) -> None:
    """Send a batch, and wait for its acknowledgement."""
    (reply,) = ask(link, keys.ingest(site.name, batch.machine), encode_batch(batch))
    if not isinstance(answer := decode_reply(reply), Ack):
        raise RuntimeError(f"the server refused a batch: {answer}")


@contextmanager
def at_work(drive: Callable[[threading.Event], None]) -> Iterator[threading.Event]:
    """Machines that send meanwhile, on a thread of their own, until left.

    drive is handed an event, which is set once it is to end, and once it has failed; then a RuntimeError says so.
    """
    ended, problems = threading.Event(), list[Exception]()

    def run() -> None:
        try:
            drive(ended)
        except Exception as error:  # handed on below
            problems.append(error)
            ended.set()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield ended
    finally:
        ended.set()
        thread.join()
    if problems:
        raise RuntimeError("the machines stopped sending: nothing was measured") from problems[0]


def settle(server: int) -> None:
    """Wait until the server has little to do."""
    end_s = time.monotonic() + SETTLE_S
    while time.monotonic() < end_s:
        cpu_s, start_s = processor_s(server), time.monotonic()
        time.sleep(1.0)
        if processor_s(server) - cpu_s < SETTLED_CORES * (time.monotonic() - start_s):
            return
    raise RuntimeError(f"the server was still busy after {SETTLE_S:g} s: nothing was measured")


def processor_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Answer at once, until ended."""
    with session(sys.argv[1]) as link:

        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, bytes(int(str(query.parameters))))

        with link.declare_queryable(EMPTY_KEY, reply):
            print(json.dumps({"ready": EMPTY_KEY}), flush=True)
            threading.Event().wait()


if __name__ == "__main__":
    main()
