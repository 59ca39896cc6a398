"""A whole agent on synthetic readings: `python -m lab.agent SECONDS` prints its share of a core and memory.

Imports an agent only.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator

from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, Imu, Reading
from protocol.site.site_config import Projection, SiteConfig
from protocol.units import GRAVITY_MPS2
from tests.memory import memory_mb

SITE = SiteConfig("lot", 49.01, 8.4, 120.0)
LEVERS_M = {"gps-1": (0.8, 0.5, 3.0), "gps-2": (0.8, -0.5, 3.0)}
START_NS, STEP_NS = 1_767_225_600_000_000_000, 10_000_000
WHEELS_EVERY, FIX_EVERY = 2, 20  # steps of 10 ms: IMU 100 Hz, encoder 50 Hz, receivers 5 Hz
SPEED_MPS, ACCEL_MPS2, RADIUS_M = 3.0, 0.5, 15.0
FIX_M2, FIX_M = 1.0, 0.3


def machine() -> MachineConfig:
    """One IMU, wheel encoders, two receivers."""
    receivers = (SensorConfig(name, "gps", Mount(lever)) for name, lever in LEVERS_M.items())
    return MachineConfig(
        "loader-1", sensors=(SensorConfig("imu", "imu"), SensorConfig("wheels", "encoder"), *receivers)
    )


def progress(seconds: float) -> tuple[float, float, float]:
    """Distance [m], speed [m/s], acceleration [m/s2] of a starting machine."""
    ramp_s = SPEED_MPS / ACCEL_MPS2
    if seconds < ramp_s:
        return ACCEL_MPS2 * seconds**2 / 2, ACCEL_MPS2 * seconds, ACCEL_MPS2
    return SPEED_MPS * (seconds - ramp_s / 2), SPEED_MPS, 0.0


def place(distance_m: float) -> tuple[float, float, float]:
    """Position [m] and heading [rad] on a circle."""
    heading = distance_m / RADIUS_M
    return 50 + RADIUS_M * math.sin(heading), 50 - RADIUS_M * math.cos(heading), heading


def bundles(seconds: int) -> Iterator[list[Reading]]:
    """Readings of a drive by second; fixes oscillate by FIX_M."""
    driven, projection = machine(), Projection(SITE)
    ticks_per_m = driven.sensors[1].ticks_per_rev / (2 * math.pi * driven.wheel_radius_m)
    for first in range(0, 100 * seconds, 100):
        readings: list[Reading] = []
        for step in range(first + 1, first + 101):
            stamp, (distance_m, speed, accel) = START_NS + step * STEP_NS, progress(step / 100)
            turn = speed / RADIUS_M
            readings.append(Imu("imu", stamp, 0.0, 0.0, turn, accel, speed * turn, GRAVITY_MPS2))
            if step % WHEELS_EVERY == 0:
                readings.append(Encoder("wheels", stamp, distance_m * ticks_per_m, distance_m * ticks_per_m))
            if step % FIX_EVERY == 0:
                readings += [_fix(name, stamp, place(distance_m), projection) for name in LEVERS_M]
        yield readings


def _fix(name: str, stamp_ns: int, at: tuple[float, float, float], projection: Projection) -> Gps:
    (ahead, left, up), (x, y, heading) = LEVERS_M[name], at
    c, s, wave_m = math.cos(heading), math.sin(heading), FIX_M * math.sin(stamp_ns / STEP_NS % 97)
    x, y = x + c * ahead - s * left + wave_m, y + s * ahead + c * left - wave_m
    return Gps(name, stamp_ns, *projection.to_geodetic(x, y, up), FIX_M2, FIX_M2, FIX_M2)


def main() -> None:
    """Print CPU time per simulated second, and peak resident memory."""
    pipeline = Pipeline(SITE, machine(), PipelineConfig())
    seconds, cpu_s = int(sys.argv[1]), 0.0
    for readings in bundles(seconds):
        start_s = time.process_time()
        pipeline.step(readings)
        cpu_s += time.process_time() - start_s
    if pipeline.pose is None:
        raise SystemExit("the agent found no pose: nothing was measured")
    print(json.dumps({"cpu_percent": 100 * cpu_s / seconds, "memory_mb": memory_mb("VmHWM") * 1e6 / 2**20}))


if __name__ == "__main__":
    main()
