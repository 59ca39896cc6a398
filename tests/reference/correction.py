"""Sample correction in numpy, bit-exact reference for the kernel."""

import numpy as np

from mapserver.calibration.correction import ANY_SHARE, HEADINGS, UNIT_VECTORS, Correction
from protocol.arrays import Table
from protocol.machine.samples import LIMITS


def in_numpy(rows: Table, c: Correction) -> Table:
    """Samples of one machine without its errors."""
    out = rows.copy()
    unit = UNIT_VECTORS[
        (np.floor(rows["heading_rad"].astype(np.float64) * (HEADINGS / (2 * np.pi)) + 0.5)).astype(int) % HEADINGS
    ]
    east, north = rows["grade_e"].astype(np.float64), rows["grade_n"].astype(np.float64)
    d = np.where(rows["speed_mps"] >= 0, 1.0, -1.0)
    c_rr = rows["c_rr"].astype(np.float64)
    applied = rows["applied_scale"].astype(np.float64)
    zero = c.zero - rows["applied_zero"].astype(np.float64)
    scale = c.scale - applied if c.most_share >= ANY_SHARE else 0.0
    share = (d * c_rr + (east * unit[:, 0] + north * unit[:, 1])) / (1.0 - applied)
    level = np.abs(share) <= c.most_share
    rolled = (c_rr - d * (zero + scale * share) - c.drags) / (1.0 + c.rolls)
    new = np.where(level, np.clip(rolled, *LIMITS["c_rr"]), c_rr)
    low, high = LIMITS["grade_e"]
    out["c_rr"] = np.where(np.isnan(share), rows["c_rr"], new.astype(np.float32))
    out["grade_e"] = np.clip(east + (zero * unit[:, 0] + c.across * unit[:, 1]), low, high)
    out["grade_n"] = np.clip(north + (zero * unit[:, 1] - c.across * unit[:, 0]), low, high)
    return out
