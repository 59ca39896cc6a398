import json
import socket
import threading

import pytest

from lab.speed.__main__ import main
from lab.speed.scaling import sizes
from lab.speed.scaling.counted import counted


def test_a_batch_is_larger_than_what_its_samples_are_and_smaller_ones_cost_more():
    batches = [next(sizes._batches(n)) for n in sizes.BATCHES]
    assert [len(batch.rows) for batch in batches] == list(sizes.BATCHES)
    numbered = [batch.first_seq for _, batch in zip(range(300), sizes._batches(3), strict=False)]
    assert numbered == list(range(1, 900, 3)), "across the end of a leg as well"


@pytest.mark.processes
def test_sizes_measures_links_journals_and_an_agent(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sizes, "BATCHES", (3, 100))
    monkeypatch.setattr(sizes, "SPEED", 10)
    assert main(["sizes", "--json", "--samples", "3000", "--seconds", "6"]) == 0
    result = json.loads(capsys.readouterr().out)
    small, large = result["rows"]
    for row in (small, large):
        assert row["batch"] < row["link_up"] < row["batch"] + 60
        assert row["link_down"] > 0
        assert row["journal"] > 70
        assert row["postgres"] > 70
    assert all(small[name] > large[name] for name in ("batch", "link_up", "link_down", "journal", "postgres"))
    (agent,) = result["agent"]
    assert agent["up_b_per_s"] > agent["samples_per_s"] * large["batch"]
    assert 10 < agent["archive_b_per_sample"] < 200


def test_a_forwarder_counts_each_direction():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def echo_twice() -> None:
            link, _ = server.accept()
            with link:
                link.sendall(2 * link.recv(100))

        threading.Thread(target=echo_twice, daemon=True).start()
        with counted(f"tcp/127.0.0.1:{port}") as (endpoint, passed):
            with socket.create_connection(("127.0.0.1", int(endpoint.rsplit(":", 1)[1]))) as link:
                link.sendall(b"12345")
                assert link.recv(10, socket.MSG_WAITALL) == b"1234512345"
            assert (passed["up"], passed["down"]) == (5, 10)
