"""Routes of machines that are named: what their newest samples say, as of a time, and what is refused."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from mapserver.query.named_machines import LOOK_BACK_NS, NamedMachines
from protocol.errors import Refusal
from protocol.queries.route_requests import RouteQuery
from protocol.queries.routing import LOADER, MACHINES, NamedMachine, decode_answer
from tests.unit.mapserver.data import NOW_NS, incoming, open_writer, refused, samples, send
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
    truck = asked(answers, NamedMachine("truck-1")).machine
    assert truck == replace(MACHINES["truck"], mass_kg=47e3, speed_mps=7.5)
    given = asked(answers, NamedMachine("truck-1", (("mass_kg", 30e3), ("speed_mps", 3.0)))).machine
    assert given == replace(truck, mass_kg=30e3, speed_mps=3.0), "what is given holds"
    then = asked(answers, NamedMachine("truck-1"), NOW_NS + 7200 * S + 60 * S).machine
    assert then.mass_kg == 22e3
    early = asked(answers, NamedMachine("loader-9"), NOW_NS + 60 * S).machine
    assert (early.mass_kg, early.speed_mps) == (9e3, 9.0)
    assert asked(answers, NamedMachine("loader-9")).machine == MACHINES["loader"], "it said so long ago"
    assert asked(answers, NamedMachine("dumper")).machine == LOADER, "it hardly moved: that is no speed"


def test_a_name_that_sent_nothing_is_refused_with_those_that_did(answers):
    problem = "'truck-7' has sent nothing to this site; machines: dumper, loader-9, truck-1; kinds:"
    with refused(Refusal.OUT_OF_RANGE, problem):
        asked(answers, NamedMachine("truck-7"))


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
