from __future__ import annotations

import pytest

from tests.fuzz import can_frames
from tests.fuzz.frames import MAKERS, run


@pytest.mark.parametrize("name", MAKERS)
def test_no_frame_raises_and_no_whole_one_is_lost(name: str):
    outcome = run(name, 1000)
    assert outcome.lost == 0
    assert outcome.read > 100
    assert outcome.malformed > 0
    assert outcome.broken_bytes > 0


def test_no_frame_of_a_bus_raises_and_no_whole_one_is_lost():
    outcome = can_frames.run(3000)
    assert outcome.lost == 0
    assert outcome.values > 300
