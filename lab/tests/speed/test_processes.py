"""Machines that send beside a measurement: ended with it, and never silently gone."""

import threading

import pytest

from lab.speed.processes import at_work


def test_machines_send_until_left() -> None:
    seen: list[bool] = []

    def drive(ended: threading.Event) -> None:
        seen.append(ended.wait(60.0))

    with at_work(drive) as ended:
        assert not ended.is_set()
    assert seen == [True]


def test_machines_that_stop_by_themselves_end_what_waits_and_are_named() -> None:
    def drive(_: threading.Event) -> None:
        raise ValueError("refused")

    with pytest.raises(RuntimeError, match="stopped sending") as raised, at_work(drive) as ended:
        assert ended.wait(60.0)
    assert isinstance(raised.value.__cause__, ValueError)
