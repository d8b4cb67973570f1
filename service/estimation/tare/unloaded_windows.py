"""Detection of unloaded windows, and checks of a baseline.

A standing foot is as quiet as one in the air, but it presses. So of all quiet windows only those
count in which no tile reads higher than in the lowest window.

The tare of a recording comes from an interval that the user names, else from frames marked as lead,
else from a window recognised as unloaded. Else there is none, which is an error: a wrong baseline
gives a wrong force that looks right.

White noise averages away with the number of readings; noise of a supply, a cable or the ground does
not. Model: a part c of the variance whose correlation over k readings is phi^k, and a white rest.
Then the mean of n readings has the variance s^2/n times::

    1 + 2 c (phi/(1-phi) - phi (1-phi^n) / (n (1-phi)^2))

(Bartlett 1946; the same sum as for the variance of a mean in Box, Jenkins, Reinsel, ch. 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Times
from devices.chips.pressure_chips import Compensation
from devices.errors import TareError
from devices.flags import FrameFlag
from devices.frames import FrameBatch, hold_temperature
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import UNLOADED_SIGMA_MIN_KPA, Tare, TareSource

_LAGS = 64
"""Largest lag of the correlation, in readings; a quarter of the readings if there are fewer."""
_TESTED = 8
_CHANCE = 3.5
"""Least sum of rho over `_TESTED` readings that is significant, in standard deviations."""
_TIMES = np.geomspace(1.0, _LAGS, 25)


class CorrelatedNoise(NamedTuple):
    """Correlated part c of the variance, (tiles,), and its time constant; 0: not significant."""

    fraction: Floats
    decay_readings: Floats


def fit_correlated_variance_fraction_and_decay(kpa: Floats) -> CorrelatedNoise:
    """Fit the correlated part of the variance of unloaded readings.

    Args:
        kpa: (n, tiles), evenly spaced, NaN where a tile gave none.
    """
    n, tiles = kpa.shape
    noise = CorrelatedNoise(np.zeros(tiles), np.zeros(tiles))
    lags = np.arange(1, min(_LAGS, n // 4) + 1)
    if len(lags) < _TESTED:
        return noise
    for tile in range(tiles):
        known = np.isfinite(kpa[:, tile])
        if not known.any() or np.ptp(kpa[known, tile]) == 0.0:
            continue
        off = np.where(known, kpa[:, tile] - kpa[known, tile].mean(), 0.0)
        # What is missing adds nothing to the sums, which makes them a little too small.
        rho = np.array([np.dot(off[:-k], off[k:]) for k in lags.tolist()]) / np.dot(off, off)
        if rho[:_TESTED].sum() >= _CHANCE * np.sqrt(_TESTED / known.sum()):
            noise.fraction[tile], noise.decay_readings[tile] = _fit_decay(rho, int(known.sum()))
    return noise


def _fit_decay(rho: Floats, n: int) -> tuple[float, float]:
    decays = np.exp(-np.arange(1, len(rho) + 1) / _TIMES[:, None])
    squares = (decays**2).sum(axis=1)
    part = readings = np.zeros(1)
    for _ in range(3):
        # About the readings' own mean, which goes with them, all of it is smaller by its variance.
        about_true = rho + compute_variance_inflation(part, readings, n) / n
        parts = np.clip((decays * about_true).sum(axis=1) / squares, 0.0, 1.0)
        misfit = parts**2 * squares - 2.0 * parts * (decays * about_true).sum(axis=1)
        best = int(np.argmin(misfit))
        part, readings = parts[[best]], _TIMES[[best]]
    return float(part[0]), float(readings[0]) if part[0] > 0.0 else 0.0


def compute_variance_inflation(
    correlated_fraction: Floats, decay_readings: Floats, n_readings: npt.ArrayLike
) -> Floats:
    """Return the variance of a mean of n readings over that of white noise.

    Args:
        correlated_fraction: (tiles,), correlated part of the variance.
        decay_readings: (tiles,), time constant in readings; 0 for white noise.
        n_readings: 1 or more, broadcast with (tiles,).
    """
    count = np.asarray(n_readings, dtype=np.float64)
    phi = np.exp(-1.0 / np.where(decay_readings > 0.0, decay_readings, 1.0))
    lasts = phi / (1.0 - phi) - phi * (1.0 - phi**count) / (count * (1.0 - phi) ** 2)
    return np.asarray(1.0 + 2.0 * np.where(decay_readings > 0.0, correlated_fraction, 0.0) * lasts)


FRAMES_MIN = 20  # fewer do not tell noise from drift
NEAR_BASELINE_KPA = 1.5
"""Largest distance of an unloaded bubble from its baseline in the rig: 5 K, by p0 / T0."""
LOADED_KPA = 3.0
"""Distance above the rig baseline, 10 K by p0 / T0, from which a tile counts as loaded, even if the
user or a flag marks it as unloaded."""
QUIET_FACTOR = 1.5
"""Largest scatter of an unloaded tile over that in the rig."""
STILL_SIGMAS = 4.0
"""Largest difference of a window's halves, or from the lowest window, in sigmas."""
STUCK_SCATTER_MAX_COUNTS = 0.5
"""Scatter in counts above which a healthy chip does not read the same count twenty times."""


RemoveRecovery = Callable[[Tare, FrameBatch], Tare]
"""Removal of what earlier loads have left in a tare's interval; see `tare_recovery`."""


@dataclass(frozen=True)
class QuietWindow:
    """Window in which every tile is quiet and still.

    Attributes:
        rows: rows of the frames.
        mean_kpa: (tiles,), mean pressures.
        sigma_kpa: (tiles,), their standard uncertainty.
    """

    rows: slice
    mean_kpa: Floats
    sigma_kpa: Floats


class TareFrames:
    """Frames in order, with their pressures and the rig data of their tiles.

    Args:
        frames: n frames.
        compensation: of the array's chips.
        calibration: of its tiles, with baselines in the rig.
        serials: of the tiles, in order.
        remove_recovery: applied to tares that may follow a load; None: they stay as they are.

    Attributes:
        kpa: (n, tiles), absolute pressures; NaN where a tile gave none.
        since_ns: (n,), from the first frame.
        rig_baseline_kpa: (tiles,), baselines in the rig; NaN where unknown.
        rig_noise_kpa: (tiles,), standard deviations of a reading there; likewise.
        is_calibrated: (tiles,), False for bare tiles, which bear no load.
        counts_per_kelvin: (tiles,), of the chips.
    """

    def __init__(
        self,
        frames: FrameBatch,
        compensation: Compensation,
        calibration: Calibration,
        serials: tuple[str, ...],
        remove_recovery: RemoveRecovery | None = None,
    ) -> None:
        self.frames, _ = hold_temperature(frames)
        self.serials = serials
        self.kpa = compensation.compute_usable_kpa(self.frames)
        self.since_ns = frames.t_ns - frames.t_ns[:1]
        entries = [calibration.find_tile_or_wildcard(serial) for serial in serials]
        self.rig_baseline_kpa = np.array(
            [e.baseline_kpa if e else None for e in entries], dtype=float
        )
        self.rig_noise_kpa = np.array([e.noise_kpa if e else None for e in entries], dtype=float)
        self.is_calibrated = np.array([entry is not None for entry in entries])
        self.counts_per_kelvin = compensation.counts_per_kelvin
        self._compensation = compensation
        self._remove_recovery = remove_recovery

    def remove_recovery(self, tare: Tare) -> Tare:
        """Return a tare without what loads before its interval have left in it."""
        return tare if self._remove_recovery is None else self._remove_recovery(tare, self.frames)

    @property
    def has_rig_baselines(self) -> bool:
        """True if the calibration has the unloaded baselines of all tiles."""
        known = np.isfinite(self.rig_baseline_kpa) & np.isfinite(self.rig_noise_kpa)
        return bool(self.is_calibrated.any() and known[self.is_calibrated].all())

    @property
    def step_noise_kpa(self) -> Floats:
        """Noise (tiles,) from differences of successive frames, which slow motion hardly changes.

        NaN where there are none.
        """
        steps_kpa = np.diff(self.kpa, axis=0)
        noise_kpa = np.full(steps_kpa.shape[1], np.nan)
        known = np.isfinite(steps_kpa).any(axis=0)  # of nothing numpy takes no deviation
        noise_kpa[known] = np.nanstd(steps_kpa[:, known], axis=0) / np.sqrt(2.0)
        return noise_kpa

    def select_quiet_windows(
        self, candidate_rows: Iterable[slice], noise_kpa: Floats
    ) -> list[QuietWindow]:
        """Return the candidates in which every tile is quiet and still.

        Args:
            candidate_rows: rows of each window.
            noise_kpa: (tiles,), noise of an unloaded tile.
        """
        found = []
        # The rubber moves behind a quiet chip.
        noise_kpa = np.maximum(noise_kpa, UNLOADED_SIGMA_MIN_KPA)
        for rows in candidate_rows:
            kpa = self.kpa[rows]
            n = len(kpa)
            if n < FRAMES_MIN or not np.isfinite(kpa).all():
                continue
            sigma_kpa = noise_kpa / np.sqrt(n)
            drift_kpa = kpa[: n // 2].mean(axis=0) - kpa[n // 2 :].mean(axis=0)
            quiet = kpa.std(axis=0, ddof=1) < QUIET_FACTOR * noise_kpa
            # Each half has sqrt(2) times the mean's uncertainty, so their difference has twice it.
            still = np.abs(drift_kpa) < STILL_SIGMAS * 2.0 * sigma_kpa
            if (quiet & still).all():
                found.append(QuietWindow(rows, kpa.mean(axis=0), sigma_kpa))
        return found

    def compute_tare(self, rows: Bools | slice, source: TareSource) -> Tare:
        """Compute the tare from the frames of `rows`.

        Raises:
            TareError: a tile has fewer than `FRAMES_MIN` readable frames among them.
        """
        kpa = self.kpa[rows]
        readable = np.isfinite(kpa).sum(axis=0)
        for serial, count in zip(self.serials, readable, strict=True):
            if count < FRAMES_MIN:
                raise TareError(
                    f"tile {serial} has {count} readable frames in the interval",
                    expected=f"at least {FRAMES_MIN}",
                    remedy="Name another interval with --tare-s BEGIN,END",
                )
        temperature_raw_counts = np.nanmean(
            np.where(np.isfinite(kpa), self.frames.temperature_raw[rows], np.nan), axis=0
        )
        # A perfectly quiet reading is still rounded to a count.
        noise_kpa = np.maximum(
            np.nanstd(kpa, axis=0, ddof=1),
            self.compute_reading_rounding_sigma_kpa(temperature_raw_counts),
        )
        t_s = self.since_ns[rows] * 1e-9
        noise = fit_correlated_variance_fraction_and_decay(kpa)
        return Tare(
            baseline_kpa=np.nanmean(kpa, axis=0),
            baseline_sigma_kpa=noise_kpa
            * np.sqrt(compute_variance_inflation(*noise, readable) / readable),
            noise_kpa=noise_kpa,
            temperature_raw_counts=temperature_raw_counts,
            t_ns=int(self.frames.t_ns[rows][-1]),
            begin_s=float(t_s[0]),
            end_s=float(t_s[-1]),
            frames=len(kpa),
            source=source,
            noise_lasting=noise.fraction,
            noise_lasting_s=noise.decay_readings * float(np.median(np.diff(t_s))),
        )

    def compute_reading_rounding_sigma_kpa(self, temperature_counts: Floats) -> Floats:
        """Return the standard uncertainty of rounding to a count, (tiles,)."""
        return self._compensation.compute_quantization_sigma_kpa(temperature_counts)

    def reject_above_rig_baseline(self, tare: Tare) -> None:
        """Reject a tare under load, which would make every later force too small.

        A colder tile reads less than in the rig, and no load does that: only more is rejected.

        Raises:
            TareError: a tile is far above its rig baseline, where that is known.
        """
        for serial, baseline_kpa, rig_kpa in zip(
            self.serials, tare.baseline_kpa, self.rig_baseline_kpa, strict=True
        ):
            if baseline_kpa > rig_kpa + LOADED_KPA:
                raise TareError(
                    f"tile {serial} reads {baseline_kpa:.2f} kPa in the interval, and "
                    f"{rig_kpa:.2f} kPa unloaded on the test rig: it seems to be loaded",
                    expected=f"at most {LOADED_KPA} kPa more",
                    remedy="Name an unloaded interval with --tare-s BEGIN,END, or calibrate at "
                    "this temperature",
                )

    def reject_stuck_for_half_of_rows(self, tare: Tare, rows: Bools | slice) -> None:
        """Reject a baseline with half of its counts equal in a row, unless the rig showed no noise.

        Raises:
            TareError: a tile repeated one count, as a stuck chip does.
        """
        count_kpa = np.sqrt(12.0) * self.compute_reading_rounding_sigma_kpa(
            tare.temperature_raw_counts
        )
        readable = np.isfinite(self.kpa[rows])
        for i in np.flatnonzero(~(self.rig_noise_kpa <= STUCK_SCATTER_MAX_COUNTS * count_kpa)):
            pressure_raw = self.frames.pressure_raw[rows][readable[:, i], i]
            begins = np.flatnonzero(np.diff(pressure_raw, prepend=pressure_raw[0] ^ 1))
            lengths = np.diff(begins, append=len(pressure_raw))
            longest = int(np.argmax(lengths))
            if lengths[longest] < max(FRAMES_MIN, len(pressure_raw) / 2):
                continue
            raise TareError(
                f"tile {self.serials[i]} gave {pressure_raw[begins[longest]]} counts "
                f"{lengths[longest]} times in a row, of {len(pressure_raw)}",
                expected="readings that scatter, as those of a part that converts do",
                remedy="It seems to hang: unplug it and plug it in again, then tare",
            )


def compute_nonempty_window_starts(
    since_ns: Times, anchor_ns: int, step_ns: int, length_ns: int
) -> Times:
    """Return the starts of the windows with at least one frame, (windows,), rising, from 0 on.

    Windows start every step before and after one instant. A long gap, or a step of the clock, has
    no windows, so their number is bounded by that of the frames.

    Args:
        since_ns: (n,), of frames, rising.
        anchor_ns: of one window.
        step_ns: from window to window; above 0.
        length_ns: of a window.
    """
    last = np.unique((since_ns - anchor_ns) // step_ns)
    numbers = np.unique(last[:, None] - np.arange(-(-length_ns // step_ns)))
    begins_ns = anchor_ns + step_ns * numbers
    return np.asarray(begins_ns[(begins_ns >= 0) & (begins_ns <= since_ns[-1])], dtype=np.int64)


def select_windows_lowest_in_every_tile(windows: list[QuietWindow]) -> list[QuietWindow]:
    """Return the windows in which no tile exceeds the lowest window by more than chance."""
    lowest_kpa = np.min([window.mean_kpa for window in windows], axis=0, initial=np.inf)
    return [
        window
        for window in windows
        # The difference of two means is uncertain by sqrt(2) times one.
        if (window.mean_kpa < lowest_kpa + STILL_SIGMAS * np.sqrt(2.0) * window.sigma_kpa).all()
    ]


RECOGNITION_SPAN_NS = 60_000_000_000
"""Time from the beginning of a recording that is searched for an unloaded window."""
WINDOW_NS = 500_000_000  # longer than in flight: a recording begins at rest


def compute_recording_tare(
    frames: FrameBatch,
    compensation: Compensation,
    calibration: Calibration,
    serials: tuple[str, ...],
    *,
    interval_s: tuple[float, float] | None = None,
    remove_recovery: RemoveRecovery | None = None,
) -> Tare:
    """Compute a recording's tare from `interval_s`, its lead, or an unloaded window.

    Args:
        frames: frames from the first of the recording on.
        compensation: of the array's chips.
        calibration: of its tiles, with baselines in the rig.
        serials: of the tiles, in order.
        interval_s: the user's interval, in seconds from the first frame.
        remove_recovery: applied to a tare that may follow a load: any but that of a lead.

    Raises:
        TareError: the interval holds too few readable frames, or none can be recognised.
    """
    if interval_s is not None:
        begin_s, end_s = interval_s
        seen = TareFrames(frames, compensation, calibration, serials, remove_recovery)
        t_s = seen.since_ns * 1e-9
        rows = (t_s >= begin_s) & (t_s <= end_s)
        tare = seen.compute_tare(rows, "interval")
        seen.reject_above_rig_baseline(tare)
        seen.reject_stuck_for_half_of_rows(tare, rows)
        return seen.remove_recovery(tare)
    lead = np.logical_and.accumulate((frames.frame_flags & FrameFlag.LEAD) != 0)
    if lead[0]:
        seen = TareFrames(frames, compensation, calibration, serials)
        tare = seen.compute_tare(lead, "lead")
        seen.reject_above_rig_baseline(tare)
        seen.reject_stuck_for_half_of_rows(tare, lead)
        return tare
    # The result must not depend on the number of frames passed.
    last_ns = frames.t_ns[0] + RECOGNITION_SPAN_NS
    frames = frames.slice_rows(0, int(np.searchsorted(frames.t_ns, last_ns, side="right")))
    seen = TareFrames(frames, compensation, calibration, serials, remove_recovery)
    found = _find_unloaded_rows(seen, calibration)
    tare = seen.compute_tare(found, "recognised")
    seen.reject_stuck_for_half_of_rows(tare, found)
    return seen.remove_recovery(tare)


def _find_unloaded_rows(seen: TareFrames, calibration: Calibration) -> slice:
    """Return the rows of the first half second with every tile quiet, still, and near its baseline.

    Raises:
        TareError: there is none, or the rig baselines are unknown.
    """
    if not seen.has_rig_baselines:
        raise TareError(
            f"calibration {calibration.name} does not say where an unloaded tile lies",
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        )
    # A bare tile is not calibrated: it may read anything, with the noise that it shows.
    noise_kpa = np.where(seen.is_calibrated, seen.rig_noise_kpa, seen.step_noise_kpa)
    begins_ns = compute_nonempty_window_starts(seen.since_ns, 0, WINDOW_NS // 2, WINDOW_NS)
    firsts, ends = np.searchsorted(seen.since_ns, [begins_ns, begins_ns + WINDOW_NS])
    windows = seen.select_quiet_windows(map(slice, firsts.tolist(), ends.tolist()), noise_kpa)
    near = [
        window
        for window in windows
        if not (np.abs(window.mean_kpa - seen.rig_baseline_kpa) >= NEAR_BASELINE_KPA).any()
    ]
    low = select_windows_lowest_in_every_tile(near)
    if not low:
        raise TareError(
            "no interval can be recognised as unloaded",
            expected=f"{WINDOW_NS / 1e9:g} s in which every tile is quiet and within "
            f"{NEAR_BASELINE_KPA} kPa of its baseline on the test rig",
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        )
    return low[0].rows
