"""The site's now: it follows the machines, and a wrong clock for no longer than it is wrong."""

from mapserver.upkeep.calibrating import RECENT, SiteClock

H, M, S = 3600, 60, 1


def test_it_is_the_newest_stamp_of_all_machines_but_those_without_a_say() -> None:
    clock = SiteClock()
    assert (clock.now_ns(), clock.passed_ns()) == (0, 0)
    clock.add("a", 0, 10)
    clock.add("b", 5, 30)
    assert (clock.now_ns(), clock.passed_ns()) == (30, 25)
    assert (clock.now_ns({"b"}), clock.passed_ns({"b"})) == (10, 10)
    assert clock.now_ns({"a", "b"}) == 30, "of nobody's it is anybody's"
    clock.mark()
    assert (clock.now_ns(), clock.passed_ns()) == (30, 0)


def test_a_clock_that_was_ahead_is_forgotten_once_it_is_right() -> None:
    clock = SiteClock()
    clock.add("a", 0, 1 * M)
    clock.add("x", 20 * H, 20 * H + 5 * S)
    assert clock.now_ns() == 20 * H + 5 * S
    clock.mark()
    clock.add("x", 20 * H + 5 * S, 20 * H + 9 * S)
    clock.add("x", 1 * M, 2 * M)
    assert clock.passed_ns() > 1 * H, "which is a new beginning"
    clock.mark()
    clock.add("a", 1 * M, 3 * M)
    assert (clock.now_ns(), clock.passed_ns()) == (3 * M, 2 * M)


def test_a_machine_that_was_ahead_and_is_silent_since_is_forgotten_after_a_while() -> None:
    clock = SiteClock()
    clock.add("x", 20 * H, 20 * H)
    for minute in range(1, RECENT + 1):
        clock.add("a", minute * M, minute * M)
        assert clock.now_ns() == 20 * H, minute
        clock.mark()
    clock.add("a", 11 * M, 11 * M)
    assert clock.now_ns() == 11 * M


def test_time_passes_the_same_where_one_clock_stays_ahead_and_where_old_samples_come_in_between() -> None:
    clock, seen = SiteClock(), []
    for minute in range(40):
        clock.add("a", minute * M, minute * M + 59)
        if minute % 3 == 0:
            clock.add("x", 20 * H + minute * M, 20 * H + minute * M + 59)
        seen.append((clock.now_ns(), clock.passed_ns()))
        clock.mark()
    assert all(20 * H <= now <= 20 * H + 40 * M for now, _ in seen)
    assert [now for now, _ in seen] == sorted(now for now, _ in seen)
    assert max(passed for _, passed in seen) <= 3 * M
