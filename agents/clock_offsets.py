"""Constant offsets between the clocks of a machine's sensors, by the motion each shows.

Receivers show speed and turn, wheels speed, gyros turn. The offset of two sensors is the lag of best agreement. With
correlation r of a quantity over n independent values, a lag's log-likelihood is -n/2 log(1 - r^2), summed over shared
quantities; its curvature gives the variance.
"""

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, BASE, MAX_DELAY_S, MAX_EARLY_S, MachineConfig, SensorConfig
from protocol.machine.readings import KINDS, Encoder, Gps, GpsVelocity, Imu, Odometry, Reading
from protocol.site.site_config import Projection, SiteConfig

STEP_S = 0.5  # interval of kept values
STEP_NS = round(STEP_S * 1e9)
THIN_NS = STEP_NS // 5 - 10_000_000  # a sensor's sooner readings are skipped to save time
WINDOW = 6  # steps of a speed: 3 s average the noise of fixes
TURN = 2  # steps on either side of a turn
HOLE_S = 2.0  # longest gap that is interpolated
BREAK_S = 3600.0  # a longer gap, or a clock change, starts anew
DRIVES_MPS = 0.7  # slower fixes show no course
PEAKS = (2.5, 97.5)  # percentiles that clip a quantity: jumps of fixes are no motion
LEAST_S = 30.0  # least common time
SURE = 10.0  # log-likelihood by which a lag must exceed none and all distant lags
SIGMAS = 2.5  # standard deviations by which clocks must differ, beyond SAME_S
LEAST_STD_S = 0.02  # least deviation of an offset; likelihoods are not so sharp
SHOWING = (Gps, GpsVelocity, Imu, Odometry, Encoder)  # kinds that show motion
BESIDE_S = 4.0  # width of the best lag's peak
SAME_S = 0.3  # negligible offset: filters inside receivers lag by as much


@dataclass(frozen=True)
class Offset:
    """Lead of a sensor's clock over the others' [s], with standard deviation; delay_s: the option that corrects it."""

    sensor: str
    ahead_s: float
    std_s: float
    delay_s: float
    others: tuple[str, ...]

    @property
    def where(self) -> str:
        """Side of the others."""
        return "ahead of" if self.ahead_s > 0 else "behind"

    def sentence(self, *, is_refused: bool = False) -> str:
        """What to do on a live machine. is_refused: by its stamps alone, which may be late yet right."""
        advice = "set its clock"
        if is_refused:
            advice = f"readings are refused, {advice}" + (", or mend its link" if self.ahead_s < 0 else "")
        elif -MAX_EARLY_S <= self.delay_s <= MAX_DELAY_S:
            advice += f", or `delay_s = {self.delay_s:.1f}` under its name"
        return f"{self.sensor} is {abs(self.ahead_s):.1f} s {self.where} {', '.join(self.others)}: {advice}"


class ClockOffsets:
    """Collects motion by sensor, over kept_s or without limit."""

    def __init__(self, machine: MachineConfig, site: SiteConfig, kept_s: float | None = None) -> None:
        projection, kept_ns = Projection(site), math.inf if kept_s is None else kept_s * 1e9
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        motions = {s.name: _motion(s, machine, projection, kept_ns) for s in machine.sensors}
        self._motions = {name: motion for name, motion in motions.items() if motion}

    def take(self, readings: Iterable[Reading]) -> None:
        """Add readings, in stamp order per sensor."""
        for reading in readings:
            motion = self._motions.get(reading.sensor)
            if motion and not 0 <= reading.stamp_ns - motion.last_ns < THIN_NS and motion.sensor.kind == reading.kind:
                motion.take(reading)

    def find(self) -> list[Offset]:
        """Sensors whose clocks differ, as far as motion shows."""
        shown = {name: signals for name, motion in sorted(self._motions.items()) if (signals := motion.signals())}
        for hub in sorted(shown, key=lambda name: -len(shown[name].values)):
            lags = {name: lag for name in shown if name != hub and (lag := _lag(shown[name], shown[hub]))}
            if lags:
                return self.named({hub: (0.0, 0.0), **lags})
        return []

    def named(self, clocks: Mapping[str, tuple[float, float]]) -> list[Offset]:
        """Clocks that differ from the majority's; in a tie, receivers are wrong.

        clocks: lead over one of them [s], and standard deviation.
        """

        def agrees(one: str, other: str) -> bool:
            (a, std_a), (b, std_b) = clocks[one], clocks[other]
            return abs(a - b) <= SAME_S + SIGMAS * math.hypot(std_a, std_b)

        def rank(members: Collection[str]) -> tuple[int, int]:
            return len(members), -sum(self._sensors[name].kind.startswith(Gps.kind) for name in members)

        most = max(([other for other in clocks if agrees(one, other)] for one in clocks), key=rank, default=[])
        if len(most) == len(clocks):
            return []
        weights = [1 / max(clocks[name][1], LEAST_STD_S) ** 2 for name in most]
        right_s = float(np.average([clocks[name][0] for name in most], weights=weights))
        named = []
        for name in sorted(clocks.keys() - set(most)):
            ahead_s, std_s = clocks[name][0] - right_s, math.hypot(clocks[name][1], sum(weights) ** -0.5)
            if abs(ahead_s) > SAME_S + SIGMAS * std_s:
                named.append(Offset(name, ahead_s, std_s, self._sensors[name].delay_s + ahead_s, tuple(sorted(most))))
        return named


@dataclass(frozen=True)
class _Signals:
    """Quantities (n,) by name, STEP_S apart from a multiple of it; NaN if unknown."""

    begin_ns: int
    values: dict[str, Floats]


class _Motion:
    """A receiver's places [m], or a sensor's roll [m] and turn [rad]."""

    def __init__(self, sensor: SensorConfig, projection: Projection, metres: float, kept_ns: float) -> None:
        """Start; `metres` per encoder tick."""
        self.sensor = sensor
        self._projection, self._metres = projection, metres
        self._up = sensor.mount.frame_from_sensor()[2].tolist()
        self._kept, self._kept_ns = deque[tuple[int, float, float]](), kept_ns
        self.last_ns = 0
        self._last: Reading | None = None
        self._first = self._second = 0.0

    def take(self, reading: Reading) -> None:
        last, self._last, self.last_ns = self._last, reading, reading.stamp_ns
        dt_s = (reading.stamp_ns - last.stamp_ns) * 1e-9 if last else 0.0
        if not 0 <= dt_s < BREAK_S:
            self._kept.clear()
        if isinstance(reading, Gps):
            if isinstance(last, Gps) and (last.lat_deg, last.lon_deg) == (reading.lat_deg, reading.lon_deg):
                return  # its stamp is not when it was measured
        elif 0 < dt_s < HOLE_S:
            self._advance(reading, last, dt_s)
        stamp_ns = self.sensor.true_ns(reading.stamp_ns)
        if self._kept and stamp_ns - self._kept[-1][0] < STEP_NS * 0.9:
            return
        if isinstance(reading, Gps):
            self._first, self._second, _ = self._projection.to_map(reading.lat_deg, reading.lon_deg, reading.height_m)
        self._kept.append((stamp_ns, self._first, self._second))
        while stamp_ns - self._kept[0][0] > self._kept_ns:  # not by count: leaping stamps would span months
            self._kept.popleft()

    def _advance(self, reading: Reading, last: Reading | None, dt_s: float) -> None:
        if isinstance(reading, Imu):
            x, y, z = self._up
            self._second += dt_s * (x * reading.gyro_x_radps + y * reading.gyro_y_radps + z * reading.gyro_z_radps)
        elif isinstance(reading, Odometry):
            self._first += dt_s * abs(reading.speed_x_mps)
            self._second += dt_s * reading.rate_z_radps
        elif isinstance(reading, GpsVelocity):
            self._first += dt_s * reading.velocity_e_mps
            self._second += dt_s * reading.velocity_n_mps
        elif isinstance(reading, Encoder) and isinstance(last, Encoder):
            ticks = reading.left_ticks - last.left_ticks + reading.right_ticks - last.right_ticks
            self._first += self._metres * abs(ticks) / 2

    def signals(self) -> _Signals | None:
        """What it shows so far; None if too short."""
        if len(self._kept) < LEAST_S or self._kept[-1][0] - self._kept[0][0] < LEAST_S * 1e9:
            return None
        begin_ns = -(-self._kept[0][0] // STEP_NS) * STEP_NS
        seconds = np.array([(stamp_ns - begin_ns) * 1e-9 for stamp_ns, _, _ in self._kept])
        times = np.arange(0.0, seconds[-1], STEP_S)
        after = np.searchsorted(seconds, times).clip(1)
        known = seconds[after] - seconds[after - 1] <= HOLE_S
        columns = np.array([row[1:] for row in self._kept]).T
        first, second = (np.where(known, np.interp(times, seconds, column), math.nan) for column in columns)
        return _Signals(begin_ns, self._quantities(first, second))

    def _quantities(self, first: Floats, second: Floats) -> dict[str, Floats]:
        if self.sensor.kind.startswith(Gps.kind):
            east, north = _change(first, WINDOW), _change(second, WINDOW)
            speed = np.hypot(east, north) / (WINDOW * STEP_S)
            course = np.where(speed > DRIVES_MPS, np.arctan2(north, east), math.nan)
            # In a bend an antenna ahead of the axle shows a later course.
            course -= self.sensor.mount.xyz_m[0] / np.maximum(speed, DRIVES_MPS) * _turned(course) / (2 * TURN * STEP_S)
            return {"speed": _capped(speed), "turn": _capped(_turned(course))}
        shown = {}
        if self.sensor.provides("speed") and self.sensor.kind != Imu.kind:
            shown["speed"] = _capped(_change(first, WINDOW) / (WINDOW * STEP_S))
        if self.sensor.provides("rate") and self.sensor.kind != Encoder.kind:
            mean = np.convolve(second, np.ones(WINDOW + 1) / (WINDOW + 1), "same")  # like a course over the window
            shown["turn"] = _capped(_change(mean, 2 * TURN))
        return shown


def _motion(sensor: SensorConfig, machine: MachineConfig, projection: Projection, kept_ns: float) -> _Motion | None:
    shows = sensor.mode == ABSOLUTE if sensor.kind == Gps.kind else sensor.frame == BASE
    if not (sensor.use and shows and KINDS[sensor.kind] in SHOWING):
        return None
    return _Motion(sensor, projection, 2 * math.pi * machine.wheel_radius_m / sensor.ticks_per_rev, kept_ns)


def _change(values: Floats, steps: int) -> Floats:
    """Change over `steps` around each value; NaN at the ends."""
    changes = np.full(len(values), math.nan)
    half = steps // 2
    changes[half : len(values) - half] = values[steps:] - values[:-steps]
    return changes


def _turned(course: Floats) -> Floats:
    """Turns of a course; reversing is no turn."""
    turns = _change(course, 2 * TURN) / math.pi
    return math.pi * (turns - np.round(turns))


def _capped(values: Floats) -> Floats:
    return np.clip(values, *np.nanpercentile(values, PEAKS)) if np.isfinite(values).any() else values


def _lag(one: _Signals, hub: _Signals) -> tuple[float, float] | None:
    """Lead over the hub's clock [s] and its standard deviation; None if undetermined."""
    shared = one.values.keys() & hub.values.keys()
    if not shared:
        return None
    likelihood = np.sum([_likelihood(one.values[quantity], hub.values[quantity]) for quantity in shared], axis=0)
    best = int(likelihood.argmax())
    elsewhere = np.abs(np.arange(len(likelihood)) - best) > BESIDE_S / STEP_S
    if likelihood[best] - likelihood[elsewhere].max(initial=0.0) < SURE or best in (0, len(likelihood) - 1):
        return None
    before, at, after = likelihood[best - 1 : best + 2].tolist()
    curvature = before - 2 * at + after
    steps = best - (len(next(iter(hub.values.values()))) - 1) + (before - after) / (2 * curvature)
    return (one.begin_ns - hub.begin_ns) * 1e-9 + steps * STEP_S, STEP_S / math.sqrt(-curvature)


def _likelihood(one: Floats, hub: Floats) -> Floats:
    """Log-likelihood (m,) of equal values by lag, from -(len(hub) - 1) steps on."""
    size = 1 << (len(one) + len(hub)).bit_length()
    (a, b), (in_a, in_b) = zip(*(_centred(values) for values in (one, hub)), strict=True)

    def summed(of_one: Floats, of_hub: Floats) -> Floats:
        by_lag = np.fft.irfft(np.fft.rfft(of_one, size) * np.conj(np.fft.rfft(of_hub, size)), size)
        return np.concatenate([by_lag[size - len(hub) + 1 :], by_lag[: len(one)]])

    count = np.maximum(np.round(summed(in_a, in_b)), 1.0)
    sum_a, sum_b = summed(a, in_b), summed(in_a, b)
    spread = (summed(a * a, in_b) - sum_a**2 / count) * (summed(in_a, b * b) - sum_b**2 / count)
    correlation = (summed(a, b) - sum_a * sum_b / count) / np.sqrt(np.maximum(spread, 1e-9))
    counts = count >= max(LEAST_S / STEP_S, min(in_a.sum(), in_b.sum()) / 2)
    return np.where(counts, -count / WINDOW / 2 * np.log1p(-(np.clip(correlation, 0.0, 0.9999) ** 2)), 0.0)


def _centred(values: Floats) -> tuple[Floats, Floats]:
    """Values less their mean, 0 if unknown; and a mask of the known."""
    known = np.isfinite(values)
    mean = values[known].mean() if known.any() else 0.0
    return np.where(known, values - mean, 0.0), known.astype(float)
