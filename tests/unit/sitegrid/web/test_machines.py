"""Machines on pages, under any number of invented names."""

import pytest

from protocol.errors import MessageError, Refusal
from protocol.wire.latest_values import MOST_NAMES
from protocol.wire.messages import Health, Pose
from sitegrid.web import machines
from sitegrid.web.machines import MOST_IN_ALL, MOST_POSES, SILENT_S, Machines


def pose(name: str, seconds: int) -> Pose:
    return Pose(name, 10**18 + seconds * 10**9, float(seconds), *[0.0] * 6)


def test_tracks_of_all_machines_together_stay_short(monkeypatch):
    monkeypatch.setattr(machines, "MOST_IN_ALL", most := MOST_IN_ALL // 20)
    known = Machines(lambda: 0.0)
    for seconds in range(MOST_POSES + 50):
        known.on_pose(pose("loader-1", seconds))
    assert len(known.tracks()["loader-1"]) == MOST_POSES
    for i in range(MOST_NAMES - 1):
        for seconds in range(5):
            known.on_pose(pose(f"made-up-{i}", seconds))
    tracks = known.tracks()
    assert len(tracks) == MOST_NAMES
    assert sum(map(len, tracks.values())) <= most
    assert tracks["loader-1"][-1].x_m == MOST_POSES + 49
    with pytest.raises(MessageError) as refused:
        known.on_pose(pose("one-more", 0))
    assert refused.value.reason == Refusal.OVERLOADED


def test_a_machine_that_is_silent_is_left_out_and_faults_are_those_of_known_ones():
    now_s = 0.0
    known = Machines(lambda: now_s)
    known.on_health(Health("nobody", 1, {}))
    known.on_pose(pose("loader-1", 0))
    now_s = SILENT_S - 1
    known.on_pose(pose("loader-2", 0))
    assert [(p["machine"], p["age_s"]) for p in known.poses()] == [("loader-1", SILENT_S - 1), ("loader-2", 0.0)]
    now_s = SILENT_S + 1
    assert [p["machine"] for p in known.poses()] == ["loader-2"]
    assert set(known.tracks()) == {"loader-1", "loader-2"}


def test_a_machine_without_a_place_says_what_it_lacks():
    known = Machines(lambda: 0.0)
    values = {"status": "no fix yet: 4 satellites", "problems": ["no fix yet: 4 satellites"], "heard": ["imu"]}
    known.on_health(Health("loader-2", 1, values | {"corrections": {"base": "b", "age_s": 1.5}}))
    known.on_pose(pose("loader-1", 0))
    known.on_findings({"loader-2": "rolls harder"})
    (report,) = known.reports()
    assert (report["machine"], report["status"], report["base"]) == ("loader-2", "no fix yet: 4 satellites", "b")
    assert report["problems"] == ["no fix yet: 4 satellites", "rolls harder"]
    assert [p["machine"] for p in known.poses()] == ["loader-1"]
    assert set(known.tracks()) == {"loader-1"}
