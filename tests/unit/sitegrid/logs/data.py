"""Synthetic logs: a machine on a circle with wheels, IMU, torque and fixes."""

from __future__ import annotations

import math
from itertools import accumulate
from pathlib import Path

RADIUS_M, RATE_RADPS = 20.0, 0.1
START_S = 1_700_000_000
MANIFEST = f"""
log = {{ name = "circle", start_ns = {START_S}000000000 }}
site = {{ name = "yard", origin_lat_deg = 50.0, origin_lon_deg = 8.0 }}
machine = {{ name = "mower", mass_kg = 1000.0, load_centre_m = 0.0 }}
[[sensor]]
name = "gps-1"
kind = "gps"
file = "gps.csv"
std = {{ position = 1.0 }}
columns = {{ stamp = "t", x_m = "x", y_m = "y" }}
[[sensor]]
name = "wheels"
kind = "odometry"
file = "odom.csv"
columns = {{ stamp = "t", speed_x_mps = "v", rate_z_radps = "w" }}
"""
SECONDS = 80


def moves(t: float) -> bool:
    """Whether the machine drives; irregular intervals."""
    return not (t < 4 or 17 <= t < 23 or 41 <= t < 44 or 60 <= t < 68)


DRIVEN_S = [0.0, *accumulate(0.1 * moves(i / 10) for i in range(10 * SECONDS))]


def at(t: float) -> tuple[float, float]:
    """A place on the circle; fixes are 5 cm off, differently each time, so that none repeats."""
    turned = RATE_RADPS * DRIVEN_S[round(t * 10)]
    off_m = 0.05 * math.sin(100 * t)
    return 100 + RADIUS_M * math.cos(turned) + off_m, 50 + RADIUS_M * math.sin(turned)


def write_circle(folder: Path) -> Path:
    """A log of 80 s: fixes at 2 Hz, wheels at 10 Hz; driving and standing."""
    times = [i / 10 for i in range(10 * SECONDS)]
    fixes = [(t, *at(t)) for t in times[::5]]
    odometry = [(t, RADIUS_M * RATE_RADPS * moves(t), RATE_RADPS * moves(t)) for t in times]
    write(folder / "gps.csv", "t,x,y", fixes)
    write(folder / "odom.csv", "t,v,w", odometry)
    (folder / "log.toml").write_text(MANIFEST)
    return folder


def write(path: Path, names: str, rows: list[tuple[float, ...]]) -> None:
    path.write_text("\n".join([names, *(",".join(f"{value:.6f}" for value in row) for row in rows)]) + "\n")


def edit(path: Path, change) -> None:
    """Change a CSV file's rows below the header."""
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *change([row.split(",") for row in rows])]) + "\n")
