"""TCP ports of this host that a set-up on one laptop uses."""

from __future__ import annotations

import socket

from protocol.wire.session import DEFAULT_ENDPOINT

HOST = "127.0.0.1"
ROUTER, PAGE = int(DEFAULT_ENDPOINT.rpartition(":")[2]), 8080


def is_free(port: int) -> bool:
    """Whether nobody listens at a port of this host."""
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((HOST, port))
        except OSError:
            return False
    return True
