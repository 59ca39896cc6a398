"""Scores of known maps, and the whole quick edition."""

import json
from pathlib import Path

import numpy as np
import pytest

from lab.benchmark import recordings, scores
from lab.benchmark.recordings import QUICK, part_hash
from lab.benchmark.scores import FIGURES, figures_of
from lab.calibration.drives import Scene, scene
from lab.campaign.experiment import Runner
from lab.campaign.true_maps import region_of, true_layers
from lab.tests.calibration.scenes import made_scene
from protocol.errors import ConfigError
from sitegrid.process.lifetime import plain
from sitegrid.proof.map_score import driven_cells
from tests.arithmetic import ARITHMETIC, arithmetic

pytestmark = pytest.mark.timeout(900)  # agents replay two recordings, maybe on a busy host
PUBLISHED = recordings.published_hashes()
STORED = Path(__file__).parent / "quick.json"


@pytest.fixture(scope="module")
def true() -> Scene:
    return made_scene()[1]


def layers_of(true: Scene) -> dict[str, np.ndarray]:
    return {name: values.astype(float) for name, values in true_layers(true.truth).items()}


def test_the_truth_is_all_right_and_nothing_is_not(true: Scene):
    right = figures_of(layers_of(true), true)
    assert [right[name] for name in FIGURES] == [100.0, 0.0, 0.0, 100.0, 0.0, 0.0, None, None]
    nothing = figures_of({name: np.full_like(values, np.nan) for name, values in layers_of(true).items()}, true)
    assert (nothing["right_pct"], nothing["known_pct"]) == (0.0, 0.0)
    assert np.isnan(nothing["wrong_resistance_pct"])


def test_errors_of_values_are_relative_and_of_gradients_in_percent(true: Scene):
    layers = layers_of(true)
    layers["resistance"] *= 1.1
    layers["grade_east"] += 0.02
    figures = figures_of(layers, true)
    assert figures["c_rms_pct"] == pytest.approx(10.0, abs=1e-3)
    assert figures["gradient_rms_pct"] == pytest.approx(2.0 / np.sqrt(2), abs=1e-3)


def test_confidence_counts_where_it_is_stated(true: Scene):
    layers = layers_of(true) | {"confidence": np.full(true.truth.c_rr.shape, 0.9)}
    assert figures_of(layers, true)["calibration_error"] == pytest.approx(0.1)
    layers["confidence"][:30] = np.nan
    assert 0.1 < figures_of(layers, true)["calibration_error"] < 0.5
    layers["confidence"][:] = np.nan
    assert figures_of(layers, true)["calibration_error"] is None


def test_hashes_are_of_names_and_contents_and_of_an_archive_s_numbers(tmp_path: Path):
    logs, truth = tmp_path / "logs", tmp_path / "truth"
    logs.mkdir()
    truth.mkdir()
    (logs / "a").write_text("1")
    (logs / "b").write_text("2")
    first = part_hash(tmp_path, "logs")
    assert first == part_hash(tmp_path, "logs")
    (logs / "b").rename(logs / "c")
    assert part_hash(tmp_path, "logs") != first
    np.savez(truth / "map.npz", a=np.arange(3))
    whole = part_hash(tmp_path, "truth")
    np.savez_compressed(truth / "map.npz", a=np.arange(3))
    assert part_hash(tmp_path, "truth") == whole
    np.savez(truth / "map.npz", a=np.arange(4))
    assert part_hash(tmp_path, "truth") != whole
    (truth / "map.npz").write_bytes(b"PK")
    assert part_hash(tmp_path, "truth") != whole


# --- from nothing to the table ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench")


@pytest.fixture(scope="module")
def made(data: Path) -> list[dict]:
    return recordings.make(Runner(data), QUICK)


@pytest.mark.slow
def test_the_quick_edition_has_the_published_hashes_and_the_stored_figures(made, data: Path):
    """Figures from `python -m lab bench score --quick --json`; other arithmetic gives other bits."""
    known = PUBLISHED[recordings.edition_key(QUICK)]
    assert {row["name"] for row in made} == set(known)
    if arithmetic() == ARITHMETIC:
        assert [row["published"] for row in made] == [True] * len(QUICK.drives)
    assert plain(scores.run(data, QUICK, (), 1)) == json.loads(STORED.read_text())


@pytest.mark.slow
def test_an_entry_of_the_same_samples_is_as_good_as_ours_and_one_of_the_truth_is_best(made, data: Path, tmp_path: Path):
    ours, best = tmp_path / "ours", tmp_path / "best"
    for folder in (ours, best):
        folder.mkdir()
    for drive in QUICK.drives:
        (ours / f"{drive.name}.csv").write_bytes((drive.folder(data) / "samples.csv").read_bytes())
        write_truth(best / f"{drive.name}.csv", scene(drive, data))
    rows = {row["entry"]: row for row in scores.run(data, QUICK, (ours, best), 1)["rows"]}
    assert {**rows["ours"], "entry": ""} == {**rows["soft_votes"], "entry": ""}
    assert (rows["best"]["right_pct"], next(iter(rows))) == (100.0, "best")
    filled, known = rows["soft_votes_filled"], rows["soft_votes"]
    assert filled["known_pct"] > known["known_pct"]
    assert filled["right_pct"] > known["right_pct"]
    assert filled["brier"] is None


def write_truth(path: Path, true: Scene) -> None:
    region = region_of(true.truth, {})
    passed = driven_cells(region, [track.place_m for track in true.tracks.values()])
    lines = ["x_m,y_m,resistance,grade_east,grade_north"]
    for row, column in zip(*passed.nonzero(), strict=True):
        values = [layer[row, column] for layer in true_layers(true.truth).values()]
        lines.append(",".join(map(str, [region.x_m[column], region.y_m[row], *values])))
    path.write_text("\n".join(lines) + "\n")


def test_without_recordings_one_line_says_what_to_do(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"`python -m lab bench make --quick --data .*` makes it"):
        scores.run(tmp_path, QUICK, (), 1)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["truth/tracks/loader-1.csv", "samples.csv"])
def test_a_recording_that_was_cut_is_not_scored_on(made, data: Path, part: str):
    path = QUICK.drives[0].folder(data) / part
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    try:
        with pytest.raises(ConfigError, match="is not what was made; delete the folder"):
            scores.run(data, QUICK, (), 1)
        if part != "samples.csv":  # samples are rewritten
            with pytest.raises(ConfigError, match="truth: is not what was made"):
                recordings.make(Runner(data), QUICK)
    finally:
        path.write_bytes(whole)
