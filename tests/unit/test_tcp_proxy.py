"""The proxy hands bytes on, counts them, and drops links when they are cut."""

import socket
import threading

import pytest

from sitegrid.process.children import wait_until
from tests.patience import PATIENCE_S
from tests.tcp_proxy import Proxy, Weather


@pytest.fixture
def echo():
    """A port that sends back twice what it gets."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                near, _ = listener.accept()
            except OSError:
                return
            with near:
                while data := near.recv(4096):
                    near.sendall(data + data)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield listener.getsockname()[1]
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(5.0)


def reach(proxy: Proxy) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(proxy.endpoint.rpartition(":")[2])), timeout=PATIENCE_S)


def test_it_counts_what_it_carries_in_each_direction(echo: int):
    with Proxy(echo) as proxy, reach(proxy) as link:
        link.sendall(b"x" * 1000)
        got = 0
        while got < 2000:
            got += len(link.recv(4096))
        wait_until(lambda: proxy.carried("back") == 2000, 5.0, "all bytes counted")
        assert proxy.carried("there") == 1000


def test_a_cut_ends_links_and_lets_none_come_up_until_it_is_over(echo: int):
    with Proxy(echo) as proxy:
        with reach(proxy) as link:
            proxy.set(Weather(cut=True))
            assert link.recv(10) == b""
        with reach(proxy) as link:
            assert link.recv(10) == b""
        proxy.set(Weather())
        with reach(proxy) as link:
            link.sendall(b"y")
            assert link.recv(10)[:1] == b"y"
