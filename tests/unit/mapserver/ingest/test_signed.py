"""A store that asks for signatures takes what the machine signed for its own key, and nothing else."""

import pytest

from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from protocol.wire import keys
from protocol.wire.messages import Ack
from sitegrid.security.signing import Signer, Verifier, make_signing_key
from tests.unit.mapserver.data import CONFIG, SITE, Incoming, incoming, now_ns, samples

PRIVATE, PUBLIC = make_signing_key()
OTHER, _ = make_signing_key()


@pytest.fixture
def store(tmp_path):
    opened = Store(JournalLocation(tmp_path), SITE, CONFIG, now_ns, Verifier({"a": PUBLIC}).check)
    yield opened
    opened.close()


def signed(machine: str = "a", key: bytes = PRIVATE, under: str = "") -> Incoming:
    batch = incoming(samples(3), machine=machine)
    return Incoming(machine, batch.payload, Signer(key).sign(keys.ingest(SITE.name, under or machine), batch.payload))


def test_a_signed_batch_is_taken(store):
    assert isinstance(store.commit([signed()])[0], Ack)
    assert store.grid.state().folded == 3


@pytest.mark.parametrize(
    ("batch", "problem"),
    [
        (incoming(samples(3)), "is not signed"),
        (signed(key=OTHER), "is not that of 'a'"),
        (signed(under="b"), "is not that of 'a'"),
        (Incoming("a", signed().payload + b"x", signed().signature), "is not that of 'a'"),
        (signed(machine="stranger"), "no signing key of 'stranger'"),
        (Incoming("", signed().payload, signed().signature), "names no machine"),
    ],
)
def test_any_other_is_refused_counted_and_leaves_no_trace(store, batch, problem):
    (answer,) = store.commit([batch])
    assert answer.reason == "wrong_machine"
    assert problem in answer.problem
    assert store.counters["refused_wrong_machine"] == 1
    assert (store.journalled, store.grid.state().folded) == (0, 0)
