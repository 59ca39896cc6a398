"""Tuning of ground estimation: one frozen set of constants, which experiments replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EstimationTuning:
    """Constants of the c_rr filters, the border search and the calibration.

    first_c_rr, unknown_std: c_rr at first, and its deviation then and behind borders. noise: least noise density of raw
    c_rr [1/sqrt(Hz)], over noise_s; a square beyond outlier times the mean is a border. walk: of c_rr on one ground
    [1/sqrt(m)]. scale_walk [1/sqrt(s)], load_std: of an estimated scale error, at first and after loading (3.5 t of
    17.5 t).

    borders_per_m: five times as many hardly matter. coloured: factor of the search's noise variance, as torque errors
    last a second; uneven: its walk on one ground [1/sqrt(m)]; likely: cap of a normalised square, so that one shock is
    no border. model_std: error of the balance [-] that calibration leaves.

    stretch_m: averaged distance, as a sample's; stretch_std: of its mean. pair_m, pair_rad, pair_s: limits of two
    passages over the same ground by dead reckoning. floor: least deviation of the bias, a tenth of the scale's.
    gate_sigma: gate of pairs; relock, relock_tours: exclusions in a row that count as right. gate_offer_sigma: beyond
    it an offer or the machine is wrong, and a person has to look.
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
