"""A store's samples with identity, as sent; and the machines' tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, NoReturn

import numpy as np

from mapserver.journal.rows import JournalRows, Selection
from protocol.arrays import AnyArray, Bools
from protocol.errors import ConfigError
from protocol.machine.readings import MAX_STAMP_NS
from protocol.machine.samples import COLUMNS
from sitegrid.export.wanted import Wanted, nothing_there
from sitegrid.features.feature import Collection
from sitegrid.features.kinds import TRACK

Samples = Mapping[str, AnyArray]  # columns by name (n,)
BREAK_NS = 30 * 10**9  # a gap ends a track: driving machines sample every few seconds
OF_TRACK = ("stamp_ns", "x_m", "y_m", "heading_rad")


def samples(wanted: Wanted) -> Iterator[Samples]:
    """Chosen samples in chunks: machine, spool_id, seq, and a sample's columns."""
    roads, rows = wanted.roads, wanted.map.rows
    if not rows:
        raise ConfigError("--what", "samples and tracks are in stores and archives: give --store")
    if roads.machine and roads.machine not in wanted.info.machines:
        raise ConfigError("--machine", f"{roads.machine} has sent nothing; {_sent(wanted)} have")
    selection = Selection(to_ns=roads.as_of_ns or MAX_STAMP_NS, bounds=roads.bounds)
    for some in rows(selection):
        if (chosen := _chosen(some, selection, roads.machine)).any():
            yield {name: values[chosen] for name, values in _columns(some).items()}


def _chosen(rows: JournalRows, selection: Selection, machine: str) -> Bools:
    chosen = selection.includes(rows.samples)
    if machine:
        is_its = np.array([name == machine for name in rows.machines], np.bool_)
        chosen &= np.repeat(is_its[rows.machine], rows.lengths)
    return chosen


def _columns(rows: JournalRows) -> Samples:
    first = np.repeat(rows.first_seqs - np.cumsum(rows.lengths) + rows.lengths, rows.lengths)
    identity = {
        "machine": np.array(rows.machines, object)[np.repeat(rows.machine, rows.lengths)],
        "spool_id": np.repeat(rows.spool_ids, rows.lengths),
        "seq": first + np.arange(len(rows.samples)),
    }
    return {**identity, **{name: rows.samples[name] for name in COLUMNS}}


def _tracks(wanted: Wanted) -> Iterator[tuple[str, Samples]]:
    """Each machine's samples by stamp."""
    parts = [{name: some[name] for name in ("machine", *OF_TRACK)} for some in samples(wanted)]
    if not parts:
        return
    whole = {name: np.concatenate([part[name] for part in parts]) for name in ("machine", *OF_TRACK)}
    for machine in sorted(set(whole["machine"])):
        its = np.flatnonzero(whole["machine"] == machine)
        order = its[np.argsort(whole["stamp_ns"][its], kind="stable")]
        yield machine, {name: whole[name][order] for name in OF_TRACK}


def tracks(wanted: Wanted) -> Collection:
    """Driven lines, split at gaps."""
    return Collection(TRACK, list(_lines(wanted)))


def _lines(wanted: Wanted) -> Iterator[dict[str, Any]]:
    for machine, its in _tracks(wanted):
        places = np.stack([its["x_m"], its["y_m"]], axis=1)
        breaks = np.flatnonzero(np.diff(its["stamp_ns"]) > BREAK_NS) + 1
        for line, stamps in zip(np.split(places, breaks), np.split(its["stamp_ns"], breaks), strict=True):
            if len(line) > 1:
                first_ns, last_ns = stamps[[0, -1]].tolist()
                yield {"machine": machine, "line": line, "first_ns": first_ns, "last_ns": last_ns}


def write_tum(file: BinaryIO, wanted: Wanted, _: object) -> dict[str, int]:
    """One machine's track as `stamp x y z qx qy qz qw` [s, m, -] in `map`; z is unknown: 0."""
    known = dict(_tracks(wanted))
    if not known:
        nothing_there(wanted.info)
    if len(known) > 1:
        _refuse_many(wanted)
    ((_machine, its),) = known.items()
    half = its["heading_rad"].astype(np.float64) / 2
    for row in zip(its["stamp_ns"].tolist(), its["x_m"], its["y_m"], np.sin(half), np.cos(half), strict=True):
        stamp_ns, x_m, y_m, z, w = row
        seconds, rest_ns = divmod(stamp_ns, 10**9)
        file.write(f"{seconds}.{rest_ns:09d} {x_m:.4f} {y_m:.4f} 0 0 0 {z:.9f} {w:.9f}\n".encode())
    return {"samples": len(half)}


def _refuse_many(wanted: Wanted) -> NoReturn:
    raise ConfigError("--machine", f"a .tum file has the track of one machine: name one of {_sent(wanted)}")


def _sent(wanted: Wanted) -> str:
    return ", ".join(sorted(wanted.info.machines))
