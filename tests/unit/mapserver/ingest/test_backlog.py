from collections import Counter

from mapserver.ingest.backlog import GROUP_BATCHES, GROUP_BYTES, MOST_RETRY_S, Backlog, Pace


def filled(batches: str, size: int = 10, limit: int = 10**9) -> Backlog[str]:
    """A backlog with batches named as their machines, numbered."""
    backlog, sent = Backlog(limit), Counter()
    for machine in batches:
        sent[machine] += 1
        backlog.add(machine, size, f"{machine}{sent[machine]}")
    return backlog


def test_who_has_had_a_turn_comes_after_those_who_wait():
    backlog = filled("a" * 2 * GROUP_BATCHES + "b")
    first = backlog.take()
    assert (len(first), first[:3]) == (GROUP_BATCHES, ["a1", "b1", "a2"])
    backlog.add("c", 10, "c1")
    assert backlog.take()[:2] == [f"a{GROUP_BATCHES}", "c1"]


def test_a_group_is_bounded_in_bytes_and_never_empty():
    backlog = filled("abc", GROUP_BYTES // 2)
    assert backlog.take() == ["a1", "b1"]
    assert filled("ab", 2 * GROUP_BYTES).take() == ["a1"]


def test_the_newest_of_the_machine_with_most_bytes_gives_way():
    backlog = filled("aaab", limit=40)
    assert backlog.add("c", 10, "c1") == ["a3"]
    assert backlog.add("c", 10, "c2") == ["c2"]  # as much as anybody has
    assert backlog.add("d", 10, "d1") == ["a2"]
    assert backlog.add("e", 10, "e1") == ["e1"]  # all have one
    assert backlog.take() == ["a1", "b1", "c1", "d1"]


def test_a_batch_larger_than_all_room_is_not_taken_and_takes_nobodys_place():
    backlog = filled("ab", limit=40)
    assert backlog.add("c", 41, "c1") == ["c1"]
    assert backlog.take() == ["a1", "b1"]


def test_the_time_until_there_is_room_follows_the_pace():
    pace = Pace()
    for _ in range(100):
        pace.worked(2_000_000, 0.5)
    assert 0.9 < pace.retry_after_s(4_000_000) < 1.1
    pace.worked(1, 0.0)  # a clock that stood still
    assert pace.retry_after_s(10**12) == MOST_RETRY_S
