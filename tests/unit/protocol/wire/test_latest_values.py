"""Values of invented names, without keys: bounded; speakers stay, the silent make room."""

from protocol.wire.latest_values import MOST_NAMES, SILENT_S, LatestValues


def test_who_speaks_keeps_its_place_and_the_silent_make_room():
    now_s = 0.0
    heard: LatestValues[int] = LatestValues(lambda: now_s)
    assert heard.hear("loader-1", 0)
    for i in range(2 * MOST_NAMES):
        assert heard.hear(f"made-up-{i}", i) == (i < MOST_NAMES - 1)
    assert len(heard) == MOST_NAMES
    now_s = SILENT_S - 1
    assert heard.hear("loader-1", 1)
    assert not heard.hear("loader-2", 1)
    now_s = SILENT_S + 1  # the invented ones are silent by now
    for i in range(MOST_NAMES - 1):
        assert heard.hear(f"loader-{i + 2}", i)
    assert (heard.get("loader-1"), heard.get("made-up-1")) == (1, None)
    assert not heard.hear("one-more", 0)
    assert {name for name, _, heard_s in heard.items() if heard_s < SILENT_S} == {"loader-1"}
