"""The simulated wheel loader as its agent knows it: nominal body, sensors and where they are mounted."""

from __future__ import annotations

from protocol.machine import MachineConfig, Mount, SensorConfig

# Antennas on the cab's roof; two IMUs under the rear frame's deck and one at the joint (paper: "under the frames").
GPS_MOUNTS = tuple(Mount(xyz) for xyz in ((0.8, 0.0, 3.35), (0.3, 0.6, 3.35), (0.3, -0.6, 3.35)))
IMU_MOUNTS = (
    Mount((0.4, 0.0, 0.9)),
    Mount((0.4, 0.5, 0.9), (0.0, 0.0, 90.0)),
    Mount((1.4, 0.0, 0.8), (180.0, 0.0, 0.0)),
)


def loader(name: str, gps: int, imus: int) -> MachineConfig:
    """Build the nominal loader with this many GPS receivers and IMUs (at most three of each).

    Fast sensors stand first: readings of one stamp then have the same order live, in bundles and in log folders.
    """
    inertial = [SensorConfig(f"imu-{i + 1}", "imu", mount) for i, mount in enumerate(IMU_MOUNTS[:imus])]
    others = [SensorConfig(*o) for o in (("torque", "torque"), ("wheels", "encoder"), ("articulation", "articulation"))]
    receivers = [SensorConfig(f"gps-{i + 1}", "gps", mount) for i, mount in enumerate(GPS_MOUNTS[:gps])]
    return MachineConfig(name, sensors=(*inertial, *others, *receivers))
