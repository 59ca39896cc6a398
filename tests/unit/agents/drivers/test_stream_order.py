import pytest

from agents.drivers.stream_order import LATE_LIMIT, Order, Verdict
from protocol.machine.readings import Articulation, Reading

MS = 1_000_000
T0 = 10**18


def at(ms: int, sensor: str = "a") -> Reading:
    return Articulation(sensor, T0 + ms * MS, 0.0)


@pytest.fixture
def order() -> Order:
    order = Order(gap_s=5.0, late_s=0.5)
    assert order.judge(at(0)) is Verdict.TAKE
    return order


def test_readings_in_order_are_taken_and_not_counted(order: Order) -> None:
    assert all(order.judge(at(ms)) is Verdict.TAKE for ms in (1, 20, 5000, 9999))
    assert not order.counters


def test_duplicate_is_refused_and_counted(order: Order) -> None:
    assert order.judge(at(0)) is Verdict.REFUSE
    assert order.counters == {"reading_duplicate": 1}


def test_two_sensors_may_share_a_stamp(order: Order) -> None:
    assert order.judge(at(0, "b")) is Verdict.TAKE


def test_sensor_s_own_readings_never_go_back(order: Order) -> None:
    order.judge(at(100))
    assert order.judge(at(99)) is Verdict.REFUSE
    assert order.counters == {"reading_late": 1}


def test_other_sensor_may_be_late_by_late_s_but_no_more(order: Order) -> None:
    order.judge(at(1000))
    assert order.judge(at(499, "b")) is Verdict.REFUSE
    assert order.judge(at(500, "b")) is Verdict.TAKE
    assert order.counters == {"reading_late": 1}


def test_late_reading_does_not_turn_the_clock_back(order: Order) -> None:
    order.judge(at(1000))
    order.judge(at(600, "b"))
    assert order.judge(at(400, "c")) is Verdict.REFUSE


def test_pause_longer_than_gap_s_restarts(order: Order) -> None:
    assert order.judge(at(5000)) is Verdict.TAKE
    assert order.judge(at(10_001)) is Verdict.RESTART
    assert order.judge(at(10_002)) is Verdict.TAKE
    assert order.counters == {"gap_restarts": 1}


def test_pause_is_one_of_all_sensors_together(order: Order) -> None:
    for ms in range(100, 9000, 100):
        order.judge(at(ms, "b"))
    assert order.judge(at(9000)) is Verdict.TAKE


def test_clock_that_was_set_back_restarts_after_a_while(order: Order) -> None:
    order.judge(at(100_000_000))
    order.counters.clear()
    verdicts = [order.judge(at(i)) for i in range(1, LATE_LIMIT + 20)]
    assert verdicts.count(Verdict.RESTART) == 1
    assert verdicts.index(Verdict.RESTART) == LATE_LIMIT
    assert verdicts[-1] is Verdict.TAKE
    assert order.counters == {"reading_late": LATE_LIMIT, "clock_back_restarts": 1}


def test_late_sensor_among_punctual_ones_never_restarts(order: Order) -> None:
    for i in range(1, 3 * LATE_LIMIT):
        assert order.judge(at(i * 10)) is Verdict.TAKE
        order.judge(at(i * 10 - 2000, "b"))
    assert "clock_back_restarts" not in order.counters
