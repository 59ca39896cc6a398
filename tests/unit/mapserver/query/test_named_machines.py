"""Routes of machines that are named: what their newest samples say, as of a time, and what is refused."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.query.named_machines import LOOK_BACK_NS, NamedMachines
from protocol.errors import QueryError, Refusal
from protocol.queries.route_requests import RouteQuery
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, decode_answer
from tests.unit.mapserver.data import NOW_NS, incoming, open_writer, samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

S = 10**9
LINE = ((0.0, 8.5), (20.0, 8.5))


def drive(stamp_ns: int, mass_kg: float, speed_mps: float = 5.0, n: int = 20):
    rows = samples(n, x_m=np.arange(n) + 0.5, stamp_ns=stamp_ns + np.arange(n) * S, mass_kg=mass_kg)
    rows["speed_mps"] = speed_mps
    return rows


@pytest.fixture
def answers(tmp_path):
    """A truck that is loaded after half an hour, one without a scale, and a loader that sent two hours ago."""
    with closing(open_writer(tmp_path)) as writer:
        half_hour, hours = 1800 * S, 7200 * S
        batches = [
            incoming(drive(NOW_NS, 9e3, 9.0), machine="loader-9"),
            incoming(drive(NOW_NS + hours, 22e3, 7.5), machine="truck-1"),
            incoming(drive(NOW_NS + hours + half_hour, 47e3, 6.0), 21, machine="truck-1"),
            incoming(drive(NOW_NS + hours + half_hour, np.nan, -0.5), machine="dumper"),
        ]
        send(writer, batches)
        yield answers_of(writer)


def asked(answers, machine: NamedMachine, as_of_ns: int | None = None):
    query = RouteQuery(LINE, machine, stops=(False, False), as_of_ns=as_of_ns)
    return decode_answer(answers.answer(query))


def test_a_named_machine_weighs_what_it_said_last_and_drives_as_fast_as_it_did(answers):
    drive = asked(answers, NamedMachine("truck-1"))
    assert drive.machine.mass_kg == 47_000.0
    assert drive.machine.speed_mps == 7.5
    assert drive.machine.power_w == MACHINES["truck"].power_w
    assert asked(answers, NamedMachine("truck-1")).machine == drive.machine


def test_as_of_a_time_it_weighs_what_it_said_until_then(answers):
    then = asked(answers, NamedMachine("truck-1"), NOW_NS + 7200 * S + 60 * S)
    assert then.machine.mass_kg == 22_000.0
    early = asked(answers, NamedMachine("loader-9"), NOW_NS + 60 * S)
    assert (early.machine.mass_kg, early.machine.speed_mps) == (9e3, 9.0)


def test_what_was_said_long_ago_or_never_is_as_of_its_kind(answers):
    assert asked(answers, NamedMachine("loader-9")).machine == MACHINES["loader"]
    assert asked(answers, NamedMachine("dumper")).machine == LOADER  # it hardly moved: that is no speed


def test_a_name_that_sent_nothing_is_refused_with_those_that_did(answers):
    with pytest.raises(
        QueryError, match="'truck-7' has sent nothing to this site; machines: dumper, loader-9, truck-1; kinds:"
    ) as caught:
        asked(answers, NamedMachine("truck-7"))
    assert caught.value.reason == Refusal.OUT_OF_RANGE


def test_new_samples_are_followed_and_old_ones_forgotten(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(drive(NOW_NS, 22e3), machine="truck-1")])
        answers = answers_of(writer)
        machines = NamedMachines(answers.source)
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == 22e3
        send(writer, [incoming(drive(NOW_NS + 60 * S, 40e3), 21, machine="truck-1")])
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == 40e3
        late_ns = NOW_NS + 3 * LOOK_BACK_NS
        send(writer, [incoming(drive(late_ns, np.nan), 41, machine="truck-1")])
        assert machines.resolve(NamedMachine("truck-1"), None).mass_kg == MACHINES["truck"].mass_kg
        fresh = NamedMachines(answers.source)
        assert fresh.resolve(NamedMachine("truck-1"), None) == machines.resolve(NamedMachine("truck-1"), None)
