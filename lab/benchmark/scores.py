"""Rules of the benchmark: scores of maps over truly driven cells, and the baselines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.benchmark.entries import CONFIDENCE, VALUES, is_samples, read_map, read_samples
from lab.benchmark.recordings import SAMPLES_FILE, BenchDrive, Edition, require_made
from lab.calibration.drives import Scene, scene
from lab.calibration.solving import served
from lab.campaign.true_maps import region_of, true_layers, window_of
from lab.campaign.workers import each
from lab.maps.cases import CELL_M
from lab.maps.methods import METHODS, Layers, folded, in_order, merge_hard
from lab.maps.uncertainty import Believed
from mapserver.config import ServerConfig
from mapserver.layers.gap_filling import AREA_LAYERS, Area
from protocol.arrays import Bools
from protocol.errors import ConfigError
from protocol.site.ground_classes import UNKNOWN, resistance_class
from sitegrid.proof.figures import Report, Row, half_width, root_mean_square, rounded
from sitegrid.proof.map_score import border_distance, driven_cells, score_driven

# The self-calibrating map server: known cells, and with filled gaps.
OURS, FILLED = "soft_votes", "soft_votes_filled"
INTERIOR_M = 2.0  # from a border; nearer cells depend on 1 m of position
# Per recording, over driven cells. Entries are ranked by right_pct, so omitting cells never pays.
FIGURES = (
    "right_pct",
    "wrong_resistance_pct",
    "wrong_grade_pct",
    "known_pct",
    "c_rms_pct",
    "gradient_rms_pct",
    "calibration_error",
    "brier",
)
DIGITS = 3
FILLING = tuple(AREA_LAYERS[f"{name}_filled"] for name in VALUES)
GROUND = tuple(dict.fromkeys(name for layer in FILLING for name in layer.needs))  # inputs of gap filling


@dataclass(frozen=True)
class Entry:
    """A baseline by name, or a folder with NAME.csv per recording."""

    name: str
    folder: Path | None = None

    def layers(self, drive: BenchDrive, cache: Path, true: Scene) -> Layers:
        """Its map of a recording; samples instead of a map go through the map server."""
        path = self.folder / f"{drive.name}.csv" if self.folder else drive.folder(cache) / SAMPLES_FILE
        if self.folder and not is_samples(path):
            return read_map(path, true.truth)
        samples, window = read_samples(path, true.tracks), window_of(true.truth)
        if self.folder or self.name == OURS:
            return folded(served(samples).items(), window)
        if self.name == FILLED:
            return gaps_filled(folded(served(samples).items(), window, GROUND))
        return merge_hard(METHODS[self.name], in_order(samples.values()), VALUES, window)


def gaps_filled(layers: Layers) -> Layers:
    """VALUES with gaps filled as by the map server."""
    read = ServerConfig().read
    area = Area(layers, CELL_M, read.fill_reach_m, read.boundaries)
    return {name: layer.derive(area) for name, layer in zip(VALUES, FILLING, strict=True)}


BASELINES = tuple(Entry(name) for name in (*METHODS, OURS, FILLED))


def run(
    cache: Path,
    edition: Edition,
    folders: Sequence[Path],
    processes: int,
    on_progress: Callable[[float, float, str], None] = lambda *_: None,
) -> Report:
    """Score baselines and folders of entries on an edition; best first."""
    entries = [*BASELINES, *(Entry(folder.resolve().name, folder) for folder in folders)]
    drives = edition.drives
    for drive in drives:
        require_made(drive, cache)
    _check_entries(entries, drives)
    jobs = [(entry, drive, cache) for drive in drives for entry in entries]
    figures: dict[tuple[str, str], Row] = {}
    for (entry, drive, _), row in each(_score, jobs, processes):
        figures[entry.name, drive.name] = row
        on_progress(len(figures), len(jobs), f"{entry.name} {drive.name}")
    rows = [summarise(entry, {drive.name: figures[entry.name, drive.name] for drive in drives}) for entry in entries]
    rows.sort(key=lambda row: -row["right_pct"])
    return {"recordings": len(drives), "seconds": edition.seconds, "rows": rows}


def _check_entries(entries: Sequence[Entry], drives: Sequence[BenchDrive]) -> None:
    """ConfigError for duplicate names, missing files or columns."""
    names = [entry.name for entry in entries]
    for entry in entries:
        if not entry.folder:
            continue
        if not entry.folder.is_dir():
            raise ConfigError(entry.folder, "is no folder; an entry is one with a file NAME.csv for each recording")
        if names.count(entry.name) > 1 or not entry.name.isprintable():
            taken = "stands in the table already" if entry.name.isprintable() else "cannot be printed"
            raise ConfigError(entry.folder, f"an entry is called as its folder, and {entry.name!r} {taken}; rename it")
        for drive in drives:
            is_samples(entry.folder / f"{drive.name}.csv")


def _score(job: tuple[Entry, BenchDrive, Path]) -> Row:
    entry, drive, cache = job
    true = scene(drive, cache)
    return figures_of(entry.layers(drive, cache, true), true)


def figures_of(layers: Layers, true: Scene) -> Row:
    """FIGURES of one map; NaN: nothing to judge, None: not stated by the map."""
    truth, tracks_m = true_layers(true.truth), [track.place_m for track in true.tracks.values()]
    region = region_of(true.truth, {name: layers[name] for name in VALUES})
    driven = score_driven(region, truth, tracks_m)
    true_kind, kind = resistance_class(truth["resistance"]), resistance_class(layers["resistance"])
    passed: Bools = driven_cells(region, tracks_m) & (true_kind != UNKNOWN)
    interior = passed & (border_distance(true_kind, true.truth.cell_m) > INTERIOR_M)
    off = layers["resistance"][interior] / truth["resistance"][interior] - 1
    gradient = np.concatenate([(layers[name] - truth[name])[passed] for name in VALUES[1:]])
    believed = _believed(layers, passed & (kind != UNKNOWN), kind == true_kind)
    values = {
        "right_pct": 100.0 * float((kind == true_kind)[passed].mean()) if passed.any() else math.nan,
        "wrong_resistance_pct": driven.wrong_resistance_pct,
        "wrong_grade_pct": driven.wrong_grade_pct,
        "known_pct": driven.known_pct,
        "c_rms_pct": 100.0 * root_mean_square(off[np.isfinite(off)]),
        "gradient_rms_pct": 100.0 * root_mean_square(gradient[np.isfinite(gradient)]),
        "calibration_error": believed.calibration_error if believed else None,
        "brier": believed.brier if believed else None,
    }
    return {name: values[name] for name in FIGURES}


def _believed(layers: Layers, known: Bools, right: Bools) -> Believed | None:
    """Stated confidence of known cells; 0.5 where missing."""
    if CONFIDENCE not in layers or not np.isfinite(layers[CONFIDENCE]).any() or not known.any():
        return None
    return Believed(np.nan_to_num(layers[CONFIDENCE][known], nan=0.5), right[known])


def summarise(entry: Entry, figures: Mapping[str, Row]) -> Row:
    """Table row: means over recordings, interval of the ranking figure, and all recordings."""
    row: Row = {"entry": entry.name}
    for name in FIGURES:
        values = [each[name] for each in figures.values()]
        row[name] = None if None in values else float(np.mean(values))
        if name == FIGURES[0]:
            row["ci95"] = half_width(np.array(values))
    return rounded({**row, "by_recording": {name: each[FIGURES[0]] for name, each in figures.items()}}, DIGITS)
