import json
from collections import Counter
from itertools import islice

import numpy as np
import pytest

from lab.speed.__main__ import main
from lab.speed.fleets import fleet
from protocol.errors import Refusal
from protocol.wire.codec import decode_batch
from protocol.wire.messages import Ack, Refused


@pytest.mark.processes
def test_fleet_measures_a_real_server_paced_and_saturated(capsys) -> None:
    """A few machines for a few seconds: what they send in time is acknowledged, and none of it is refused."""
    assert main(["fleet", "--json", "--machines", "8", "--seconds", "3", "--hours", "0.02"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["seconds"], result["goals"]) == ("fleet", 3.0, fleet.GOALS)
    paced, saturated = result["rows"]
    assert (paced["load"], saturated["load"]) == ("paced", "saturated")
    assert 0 < paced["samples_per_s"] <= 8 * fleet.SAMPLES * 4 / 3  # the first at once, then one a second
    assert saturated["samples_per_s"] > 2 * paced["samples_per_s"]
    for row in result["rows"]:
        assert (row["machines"], row["refused"]) == (8, 0)
        assert 0 < row["ack_ms_p50"] <= row["ack_ms_p99"]
        assert 0 < row["server_cores"] < 2
        assert 0 <= row["router_cores"] < 2  # of a few paced messages, less than the clock of processes shows
        assert row["server_mb"] > row["router_mb"] > 10
        assert row["disk_mb_per_s"] >= 0
    assert saturated["router_cores"] > 0


class Link:
    """Stands for a session: takes batches as a server does, but refuses some and answers at once."""

    def __init__(self) -> None:
        self.taken: Counter[str] = Counter()
        self.refuse = 0

    def get(self, key: str, handler, payload: bytes, timeout: float) -> None:
        sent = decode_batch(payload, 1e9)
        assert sent.first_seq == self.taken[sent.machine] + 1  # each sample once, in order
        assert (len(sent.rows), key.rsplit("/", 1)[-1]) == (fleet.SAMPLES, sent.machine)
        self.refuse -= 1
        if self.refuse >= 0:
            self.answers.put((self.number, 0.0, Refused(Refusal.OVERLOADED, "", retry_after_s=0.01)))
            return
        self.taken[sent.machine] += len(sent.rows)
        self.answers.put((self.number, 0.0, Ack(sent.last_seq, 1)))


def test_a_machine_that_was_refused_sends_the_same_again(monkeypatch) -> None:
    link = Link()
    link.refuse = 2
    real = fleet._ask

    def ask(one, number, answers) -> None:
        link.number, link.answers = number, answers
        real(one, number, answers)

    monkeypatch.setattr(fleet, "_ask", ask)
    machines = [fleet.Machine(f"m-{i}", link, fleet.samples(i)) for i in range(2)]  # type: ignore[arg-type]
    result = fleet.send(machines, 0.05, 0.02)
    assert result.refused == 2
    assert result.samples == sum(link.taken.values()) > 0
    assert len(result.ms) * fleet.SAMPLES == result.samples


def test_a_refusal_that_stays_ends_the_measurement() -> None:
    one = fleet.Machine("m", Link(), iter(()))  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="refused a batch"):
        fleet._take(one, Refused(Refusal.WRONG_FRAME, ""), 0.0, 1.0, fleet.Acknowledgements())


def test_machines_drive_on_the_day_after_that_of_the_store_each_on_its_own() -> None:
    first, again, other = (np.concatenate(list(islice(fleet.samples(i), 60))) for i in (0, 0, 1))
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert (np.diff(first["stamp_ns"]) > 0).all()
    assert first["stamp_ns"][0] >= fleet.DAY_NS + 1_767_225_600_000_000_000
