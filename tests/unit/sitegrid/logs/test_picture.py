"""The picture of a replayed log: contents and places."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from protocol.machine.log_folder import open_log
from sitegrid.logs import picture as pictures
from sitegrid.logs.log_truth import LogTruth
from sitegrid.logs.outages import Outage
from sitegrid.logs.picture import picture
from sitegrid.logs.replay import Trace
from sitegrid.logs.run import Recording
from sitegrid.proof.tracks import Truth
from tests.unit.sitegrid.logs.data import START_S, at, write_circle


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    log = open_log(write_circle(tmp_path))
    return Recording(log, list(log.readings()))


def trace(error_m: float = 0.0, n: int = 400) -> Trace:
    stamps = START_S * 10**9 + np.arange(n) * 200_000_000
    places = np.array([at(i / 5) for i in range(n)]) + np.array([error_m, 0.0])
    return Trace(
        stamps, places, np.broadcast_to(np.eye(2), (n, 2, 2)), np.zeros(n), int(stamps[0]), int(stamps[-1]), 0.0
    )


def colours(image: np.ndarray) -> set[tuple[int, ...]]:
    """Colours without the legend."""
    numbers = np.unique(image[66:-52, 84:-200].astype(int) @ [1, 256, 256**2])
    return {(n % 256, n // 256 % 256, n // 256**2) for n in numbers.tolist()}


def test_track_fixes_ellipses_and_axes_are_drawn(recording: Recording) -> None:
    drawn = picture(recording, None, trace())
    assert {pictures.TRACK, pictures.FIX, pictures.ELLIPSE} <= colours(drawn)
    assert not {pictures.WITHHELD, pictures.TRUTH} & colours(drawn)
    assert max(drawn.shape[:2]) <= pictures.MAX_SIDE_PX + 400


def test_truth_and_withheld_fixes_have_colours_of_their_own(recording: Recording) -> None:
    off = Truth(trace(3.0).stamp_ns, trace(3.0).position_m)
    known = replace(recording, truth=LogTruth(off, np.zeros(3)))
    assert {pictures.WITHHELD, pictures.TRUTH} <= colours(picture(known, Outage(20.0, 20.0), trace()))


def test_an_ellipse_is_as_large_as_its_covariance_says(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """One pose with standard deviations of 4 m east, 1 m north."""
    drawn: list[tuple[list[int], float]] = []
    monkeypatch.setattr(cv2, "ellipse", lambda *words, **_: drawn.append((words[2], words[3])))
    one = trace(n=1)
    wide = Trace(**{**vars(one), "covariance_m2": np.array([[[16.0, 0.0], [0.0, 1.0]]])})
    picture(recording, None, wide)
    ((radii, turn),) = drawn
    assert radii[1] / radii[0] == pytest.approx(4.0, rel=0.01)
    assert abs(turn) % 180 == pytest.approx(90.0)


def test_stray_fixes_do_not_make_the_rest_small(recording: Recording, tmp_path: Path) -> None:
    near = picture(recording, None, trace())
    rows = (tmp_path / "gps.csv").read_text() + "80,9000,9000\n"
    (tmp_path / "gps.csv").write_text(rows)
    strays = replace(recording, readings=list(recording.log.readings()))
    assert picture(strays, None, trace()).shape == near.shape
