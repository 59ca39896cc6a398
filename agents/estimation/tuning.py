"""What tunes the estimators of the ground: one frozen set of constants, which experiments replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EstimationTuning:
    """All constants of the filters over c_rr, of the search for borders, and of the calibration at work.

    first_c_rr, unknown_std: c_rr at first, and how unsure it is then and behind a border. noise: least density of the
    noise of raw c_rr [1/sqrt(Hz)], measured over noise_s; a square beyond outlier times the mean is a border, not
    noise. walk: random walk of c_rr [1/sqrt(m)], as ground of one kind is never quite even. scale_walk [1/sqrt(s)],
    load_std: of the scale error where the mass is estimated, at first and when the load has changed (3.5 t of 17.5 t).

    borders_per_m: maps with five times as many hardly differ. coloured: the noise as the search takes it, times its
    variance, as a torque's error lasts a second; uneven: its random walk on one ground [1/sqrt(m)]; likely: a square
    beyond so many times the variance counts as so many, so that a single jolt is no border.

    model_std: error of the balance itself [-], which no calibration removes.

    stretch_m: distance that is averaged, as long as a sample stands for; stretch_std: of its mean unbalanced. pair_m,
    pair_rad, pair_s: two passages so near, alike and soon are over the same ground; dead reckoning drifts. floor: no
    number of pairs makes the zero surer, or the scale than ten times it. gate_sigma: pairs further off are excluded;
    relock, relock_tours: so many excluded in a row are right (tours are minutes apart). gate_offer_sigma: an offer is
    of many samples, so that further off one of both is wrong, and a person has to look.
    """

    first_c_rr: float = 0.03
    unknown_std: float = 0.1
    noise: float = 0.004
    noise_s: float = 20.0
    outlier: float = 16.0
    walk: float = 0.002
    scale_walk: float = 1e-3
    load_std: float = 0.2
    borders_per_m: float = 0.02
    coloured: float = 2.0
    uneven: float = 5e-4
    likely: float = 9.0
    model_std: float = 0.0015
    stretch_m: float = 0.5
    stretch_std: float = 0.008
    pair_m: float = 0.7
    pair_rad: float = 0.15
    pair_s: float = 120.0
    floor: float = 0.0007
    gate_sigma: float = 3.0
    relock: int = 12
    relock_tours: int = 3
    gate_offer_sigma: float = 4.0


TUNING = EstimationTuning()
