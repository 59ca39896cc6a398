"""`sitegrid query`: ask the map from the command line."""

from __future__ import annotations

import math
from argparse import Namespace
from typing import Any

import numpy as np

from protocol.arrays import Floats32
from protocol.errors import ConfigError
from protocol.queries import Region
from sitegrid.client import Client, connect
from sitegrid.process import plain, say


def run(arguments: Namespace) -> int:
    """Ask once and print the answer."""
    layers = tuple(part for part in arguments.layers.split(",") if part)
    with connect(arguments.endpoint, arguments.site) as client:
        {"point": _point, "region": _region, "info": _info}[arguments.ask](client, arguments, layers)
    return 0


def _point(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> None:
    answer = client.point(arguments.x_m, arguments.y_m, layers, after=arguments.after)
    if arguments.json:
        say(plain({"x_m": answer.x_m, "y_m": answer.y_m, **answer.values, "merged": answer.merged}))
        return
    print(f"cell at {answer.x_m:g}, {answer.y_m:g} m")
    for name, value in answer.values.items():
        print(f"  {name:18} {'unknown' if math.isnan(value) else f'{value:.4g}'}")


def _region(client: Client, arguments: Namespace, layers: tuple[str, ...]) -> None:
    sides = (arguments.west_m, arguments.south_m, arguments.east_m, arguments.north_m)
    try:
        region = client.region(sides, layers, after=arguments.after)
    except ValueError as error:
        raise ConfigError("sitegrid query region", str(error)) from None
    if arguments.out:
        arrays: dict[str, Any] = {"x_m": region.x_m, "y_m": region.y_m, **region.layers}
        np.savez_compressed(arguments.out, **arrays)
    summary = {name: _statistics(values) for name, values in region.layers.items()}
    if arguments.json:
        say(plain({"columns": len(region.x_m), "rows": len(region.y_m), "merged": region.merged, "layers": summary}))
        return
    print(f"{_size(region)}, journal row {region.merged}")
    for name, row in summary.items():
        span = f"min {row['min']:.4g}   mean {row['mean']:.4g}   max {row['max']:.4g}"
        print(f"  {name:18} {row['known']:7d} known   {span}")


def _info(client: Client, arguments: Namespace, _: tuple[str, ...]) -> None:
    info = client.info(after=arguments.after)
    if arguments.json:
        say(plain(info))
        return
    print(f"site {info['site']['name']}: {info['cells']} cells known, bounds {info['bounds']}")
    print(f"  journal row {info['journalled']}, merged {info['merged']}, snapshot {info['snapshot']}")
    print(f"  samples merged {info['samples_merged']}, too unsure of their place {info['samples_too_unsure']}")
    for name, machine in sorted(info["machines"].items()):
        print(f"  {name}: {machine['samples']} samples, {machine['lost']} lost, {machine['spools']} spools")
    for name, count in sorted(info["counters"].items()):
        print(f"  {name}: {count}")


def _statistics(values: Floats32) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return {"known": 0, "min": math.nan, "mean": math.nan, "max": math.nan}
    return {"known": known.size, "min": float(known.min()), "mean": float(known.mean()), "max": float(known.max())}


def _size(region: Region) -> str:
    b = region.bounds
    return f"{b.west_m:g}..{b.east_m:g} x {b.south_m:g}..{b.north_m:g} m, {region.cell_m:g} m cells"
