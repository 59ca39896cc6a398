"""Figures of Xiang et al., "Where am I? SLAM for Mobile Machines on A Smart Working Site".

A group is a filter with numbers of GPS receivers and IMUs; wheel encoders are always used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Group = tuple[str, int, int]  # filter, GPS receivers, IMUs
PRINTED = 5e-4  # half of the last printed digit [m], the tolerance of nets


@dataclass(frozen=True)
class Published:
    """RMSE of one group [m]; of a map, wrong cells [%] among plotted ones."""

    rmse_x_m: float
    rmse_y_m: float
    net_m: float
    wrong_resistance_pct: float | None = None
    wrong_grade_pct: float | None = None

    @property
    def net_of_parts_m(self) -> float:
        """Net error from x and y."""
        return math.hypot(self.rmse_x_m, self.rmse_y_m)

    @property
    def is_consistent(self) -> bool:
        """Whether x, y and net agree as printed."""
        return abs(self.net_of_parts_m - self.net_m) <= 2 * PRINTED


# Tables 1 and 2: positions.
POSITIONS: dict[Group, Published] = {
    ("ekf", 0, 1): Published(69.122, 30.039, 75.3671),
    ("ekf", 1, 1): Published(2.472, 2.802, 3.7363),
    ("ekf", 1, 2): Published(2.172, 2.480, 3.2963),
    ("ekf", 1, 3): Published(2.474, 2.840, 3.7660),
    ("ekf", 2, 1): Published(1.830, 2.050, 2.7474),
    ("ekf", 2, 2): Published(1.778, 1.968, 2.6517),
    ("ekf", 2, 3): Published(1.894, 1.593, 2.4747),
    ("ekf", 3, 3): Published(1.794, 1.437, 2.2980),
    ("ukf", 0, 1): Published(56.586, 32.944, 65.4774),
    ("ukf", 1, 1): Published(1.654, 1.632, 2.3234),
    ("ukf", 1, 2): Published(1.374, 1.817, 2.2781),
    ("ukf", 1, 3): Published(1.611, 2.001, 2.5742),
    ("ukf", 2, 1): Published(1.093, 1.330, 1.7217),
    ("ukf", 2, 2): Published(0.975, 1.200, 1.5460),
    ("ukf", 2, 3): Published(0.873, 1.098, 1.4024),
    ("ukf", 3, 3): Published(0.826, 0.933, 1.2458),
}
# Table 3 and its text: positions while plotting, maps' J_r and J_s.
PLOTTING: dict[Group, Published] = {
    ("ekf", 1, 1): Published(2.584, 3.407, 4.4444, 2.389, 2.258),
    ("ukf", 1, 1): Published(2.003, 2.314, 3.0603, 1.482, 1.682),
    ("ukf", 2, 1): Published(1.336, 1.533, 2.0334, 0.997, 1.223),
}
