import pytest

from agents.stream_order import Decision, StreamOrder, by_stamp
from protocol.machine.clock_watch import LATE_LIMIT
from protocol.machine.readings import Articulation, Encoder, Odometry, Reading

MS = 1_000_000
T0 = 10**18


def at(ms: int, sensor: str = "a") -> Reading:
    return Articulation(sensor, T0 + ms * MS, 0.0)


@pytest.fixture
def order() -> StreamOrder:
    order = StreamOrder()
    assert order.decide(at(0)) is Decision.ACCEPT
    return order


ACCEPT, REFUSE, RESTART = Decision.ACCEPT, Decision.REFUSE, Decision.RESTART


@pytest.mark.parametrize(
    ("rows", "counters"),
    [
        ([(1, "a", ACCEPT), (20, "a", ACCEPT), (5000, "a", ACCEPT), (9999, "a", ACCEPT)], {}),
        ([(0, "a", REFUSE), (0, "b", ACCEPT)], {"reading_duplicate": 1}),
        ([(100, "a", ACCEPT), (99, "a", REFUSE)], {"reading_late": 1}),  # one sensor's stamps never go back
        ([(1000, "a", ACCEPT), (499, "b", REFUSE), (500, "b", ACCEPT), (400, "c", REFUSE)], {"reading_late": 2}),
        (
            [*((ms, "a", ACCEPT) for ms in (3000, 4000, 5000)), (10_001, "a", REFUSE), (11_002, "a", RESTART)],
            {"gap_restarts": 1, "reading_ahead": 1},  # after a second of the new clock
        ),
        ([*((ms, "b", ACCEPT) for ms in range(100, 9000, 100)), (9000, "a", ACCEPT)], {}),  # a pause concerns all
    ],
)
def test_what_is_accepted(order: StreamOrder, rows: list[tuple[int, str, Decision]], counters: dict[str, int]) -> None:
    assert [order.decide(at(ms, sensor)) for ms, sensor, _ in rows] == [decision for *_, decision in rows]
    assert order.counters == counters


def test_clock_that_was_set_back_restarts_after_a_while(order: StreamOrder) -> None:
    for i in range(LATE_LIMIT):
        order.decide(at(100 + i))
    decisions = [order.decide(at(i - 3_600_000)) for i in range(1, LATE_LIMIT + 20)]
    assert decisions.count(Decision.RESTART) == 1
    assert decisions.index(Decision.RESTART) == LATE_LIMIT
    assert decisions[-1] is Decision.ACCEPT
    assert order.counters == {"reading_late": LATE_LIMIT, "clock_back_restarts": 1}


def test_late_sensor_among_punctual_ones_never_restarts(order: StreamOrder) -> None:
    for i in range(1, 3 * LATE_LIMIT):
        assert order.decide(at(i * 10)) is Decision.ACCEPT
        order.decide(at(i * 10 - 2000, "b"))
    assert "clock_back_restarts" not in order.counters


# --- equal stamps ----------------------------------------------------------------------------------------------------


def gathered(order: StreamOrder, readings: list[Reading]) -> list[list[Reading]]:
    groups = [order.gather(reading, reading.stamp_ns) for reading in readings]
    return [group for group in [*groups, order.rest()] if group]


def test_readings_of_a_time_are_held_until_one_of_another_time_comes() -> None:
    readings = [at(0), at(0, "b"), at(10, "b"), at(5), at(10)]
    assert gathered(StreamOrder(), readings) == [readings[:2], [readings[2]], [readings[3]], [readings[4]]]


def test_one_reading_of_a_sensor_is_held_and_a_second_is_counted() -> None:
    """A stopped clock fills no memory."""
    order = StreamOrder()
    assert gathered(order, [at(0), *[at(0)] * 1000, at(10)]) == [[at(0)], [at(10)]]
    assert order.counters == {"reading_duplicate": 1000}


def test_those_of_a_stamp_come_together_by_name_and_wheels_last() -> None:
    stamp = T0 + 10 * MS
    wheels: list[Reading] = [Encoder("a", stamp, 0, 0), Odometry("b", stamp, 0, 0, 0)]
    others = [at(10, "c"), at(10, "z")]
    groups = list(by_stamp([wheels[1], others[1], at(20), wheels[0], others[0], at(0)]))
    assert groups == [[at(0)], [*others, *wheels], [at(20)]]
