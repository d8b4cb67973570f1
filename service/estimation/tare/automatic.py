"""Automatic tare: follows the drift of baselines while the stream runs, without taring loads away.

A slow load looks like a dome that warms up. The chip's temperature tells them apart, and limits
bound the error: beyond the change that temperature explains a baseline moves by at most
`SHIFT_MAX_KPA` at once, `TARE_INTERVAL_MIN_NS` apart, and by `TOTAL_SHIFT_MAX_KPA` in all since the
last tare by hand. So at most half a newton of a slow load on a tile is tared away.

The tare comes from the newest unloaded window among the last frames of the stream.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Bools, Floats, Times
from devices.errors import TareError
from devices.frames import NOT_READ, FrameBatch
from service.estimation.tare.tare import (
    TEMPERATURE_CHANGE_MAX_K,
    Tare,
    compute_sealed_gas_shift_kpa,
    compute_warming_k,
)
from service.estimation.tare.unloaded_windows import (
    FRAMES_MIN,
    LOADED_KPA,
    NEAR_BASELINE_KPA,
    TareFrames,
    compute_nonempty_window_starts,
    select_windows_lowest_in_every_tile,
)

HISTORY_NS = 10_000_000_000  # a foot that walks is in the air within that time
WINDOW_NS = 250_000_000  # fits into the flight of a hop, and holds enough readings
WINDOW_MAX_NS = 1_000_000_000
"""Longest window, for slow arrays, whose shorter windows have too few frames."""


def compute_newest_unloaded_tare(
    recent: TareFrames, *, present: Tare | None, is_load_bearing: Bools | None = None
) -> Tare:
    """Compute the tare from the newest unloaded window of the last frames.

    A window counts if every tile is quiet and still, no tile is higher than in the lowest such
    window, and none is far above the present tare or, without one, the rig baseline.

    Args:
        recent: the last `HISTORY_NS` of the stream, in order.
        present: the tare in force.
        is_load_bearing: (tiles,), False for bare tiles, which follow the weather; None: all bear
            load.

    Raises:
        TareError: the foot was loaded or moved all the time, or a tile gave no readings.
    """
    frames, since_ns = recent.frames, recent.since_ns
    there = np.isfinite(recent.kpa).any(axis=0)
    if not there.all():
        silent = [recent.serials[i] for i in np.flatnonzero(~there)]
        raise TareError(
            f"tile {', '.join(silent)} gave no readings in the last seconds",
            remedy="Plug it in, or take it out of the scene",
        )
    if len(frames) < FRAMES_MIN:
        raise TareError(f"only {len(frames)} frames have come", expected=f"at least {FRAMES_MIN}")
    usual_kpa = _compute_usual_noise_kpa(recent, present)
    windows = recent.select_quiet_windows(_iterate_windows_newest_first(since_ns), usual_kpa)
    if not windows:
        raise TareError(
            "the foot moved or was loaded all the time in the last seconds",
            expected=f"{WINDOW_NS / 1e9:g} s at rest in the air",
            remedy="Lift the foot, hold it still for a second, and tare again",
        )
    low = select_windows_lowest_in_every_tile(windows)
    if not low:
        raise TareError(
            "no tile was unloaded while all others were, in the last seconds",
            remedy="Lift the whole foot, hold it still for a second, and tare again",
        )
    tare = recent.compute_tare(low[0].rows, "unloaded")
    if present is not None:
        _reject_above(tare, present, recent.serials, is_load_bearing)
    _reject_warming(recent, frames, tare)
    recent.reject_above_rig_baseline(tare)
    recent.reject_stuck_for_half_of_rows(tare, low[0].rows)
    return tare


def _compute_usual_noise_kpa(recent: TareFrames, present: Tare | None) -> Floats:
    """Return each tile's noise at rest: the rig's, else the present tare's, else that of steps."""
    usual_kpa = recent.rig_noise_kpa
    if present is not None:
        usual_kpa = np.where(np.isnan(usual_kpa), present.noise_kpa, usual_kpa)
    floor_kpa = recent.compute_reading_rounding_sigma_kpa(
        np.nanmedian(recent.frames.temperature_raw, axis=0)
    )
    steps_kpa = np.maximum(recent.step_noise_kpa, floor_kpa)
    return np.where(np.isnan(usual_kpa), steps_kpa, usual_kpa)


def _iterate_windows_newest_first(since_ns: Times) -> Iterator[slice]:
    """Yield the rows of windows that begin a quarter of a window apart."""
    enough_ns = 1.25 * FRAMES_MIN * float(np.median(np.diff(since_ns)))
    window_ns = int(min(max(WINDOW_NS, enough_ns), WINDOW_MAX_NS))
    last_ns = int(since_ns[-1]) - window_ns
    begins_ns = compute_nonempty_window_starts(since_ns, last_ns, -(-window_ns // 4), window_ns)
    begins_ns = begins_ns[begins_ns <= last_ns][::-1]
    firsts = np.searchsorted(since_ns, begins_ns)
    ends = np.searchsorted(since_ns, begins_ns + window_ns, side="right")
    return map(slice, firsts.tolist(), ends.tolist())


def _reject_warming(recent: TareFrames, frames: FrameBatch, tare: Tare) -> None:
    """Reject a tare while a chip's temperature changes: its gas lags by seconds."""
    temperature_raw = np.where(
        frames.temperature_raw == NOT_READ, np.nan, frames.temperature_raw.astype(np.float64)
    )
    since_ns = frames.t_ns - frames.t_ns[0]
    begin = temperature_raw[since_ns <= WINDOW_NS]
    known = np.isfinite(begin).any(axis=0)
    begin_counts = np.full(len(recent.serials), np.nan)
    begin_counts[known] = np.nanmean(begin[:, known], axis=0)
    moved_k = np.nan_to_num(np.abs(compute_warming_k(tare, begin_counts, recent.counts_per_kelvin)))
    worst = int(np.argmax(moved_k))
    if moved_k[worst] > TEMPERATURE_CHANGE_MAX_K:
        raise TareError(
            f"the temperature of tile {recent.serials[worst]} has moved by {moved_k[worst]:.1f} K "
            "in the last seconds, and the gas in its dome is still behind",
            expected=f"at most {TEMPERATURE_CHANGE_MAX_K:.2f} K in {HISTORY_NS / 1e9:g} s",
            remedy="Wait for half a minute and tare again",
        )


def _reject_above(
    tare: Tare,
    present: Tare,
    serials: tuple[str, ...],
    is_load_bearing: Bools | None,
) -> None:
    rise_kpa = tare.baseline_kpa - present.baseline_kpa
    if is_load_bearing is not None:
        rise_kpa = np.where(is_load_bearing, rise_kpa, -np.inf)
    worst = int(np.argmax(rise_kpa))
    if rise_kpa[worst] > NEAR_BASELINE_KPA:
        raise TareError(
            f"tile {serials[worst]} reads {rise_kpa[worst]:.2f} kPa more than at the last tare: "
            "the foot seems to be loaded",
            expected=f"at most {NEAR_BASELINE_KPA} kPa, as 5 K of warming give",
            remedy="Lift the foot and tare again; if it really has warmed up so much, undo the "
            "last tare first",
        )


TARE_INTERVAL_MIN_NS = 60_000_000_000
"""Least time between two automatic tares."""
SHIFT_RATE_MAX_KPA_PER_S = 0.005
"""Fastest shift of a baseline: a kelvin a minute, as of a dome in the sun."""
SHIFT_MAX_KPA = 0.15
"""Largest single shift beyond the shift by temperature: 0.3 N on a tile, the noise of a reading."""
TOTAL_SHIFT_MAX_KPA = 0.25
"""Largest shift in all since the last tare that was not automatic: half a newton."""
THERMAL_SHIFT_UNCERTAINTY = 0.5
"""Uncertain part of the shift by temperature: gas and chip differ, and the wall gives way."""
RECOVERY_NS = 100_000_000
"""Recovery time of the rubber after a contact, before a window may start."""
RENEWAL_NS = 900_000_000_000
"""Time after which a tare without drift is renewed, long before it counts as old."""
SHIFT_MIN_SIGMAS = 4.0  # of both tares: less may be chance
SHIFT_MIN_KPA = 0.02
"""Least shift that makes an entry in the history."""


@dataclass(frozen=True)
class FlightTareResult:
    """Result of a check of the last seconds.

    Attributes:
        tare: to be put in force; None if the present one is good.
        reason: reason for the tare, for the history.
        rejection: reason why no tare was made although the foot seems to be in the air.
    """

    tare: Tare | None = None
    reason: str = ""
    rejection: str | None = None


NO_TARE = FlightTareResult()


def propose_flight_tare(
    recent: TareFrames,
    *,
    present: Tare,
    last_manual: Tare | None,
    no_contact_since_t_ns: int,
    is_load_bearing: Bools | None = None,
) -> FlightTareResult:
    """Propose a tare for a foot in the air, or none, with the reason.

    Args:
        recent: the last `HISTORY_NS` of the stream, in order.
        present: the tare in force.
        last_manual: the last tare that was not automatic; None without one.
        no_contact_since_t_ns: start of the present time without contact, known in every frame.
        is_load_bearing: (tiles,), False for bare tiles, which follow the weather and no load;
            None: all do.
    """
    frames, serials = recent.frames, recent.serials
    if is_load_bearing is None:
        is_load_bearing = np.ones(len(serials), dtype=bool)
    if not len(frames) or frames.t_ns[-1] - no_contact_since_t_ns < RECOVERY_NS + WINDOW_NS:
        return NO_TARE
    try:
        tare = compute_newest_unloaded_tare(
            recent, present=present, is_load_bearing=is_load_bearing
        )
    except TareError:  # it moves, a tile is silent, or it bears a load: no flight
        return NO_TARE
    begin_t_ns = int(frames.t_ns[0]) + round(tare.begin_s * 1e9)
    if (
        begin_t_ns < no_contact_since_t_ns + RECOVERY_NS
        or tare.t_ns - present.t_ns < TARE_INTERVAL_MIN_NS
    ):
        return NO_TARE
    is_renewal = tare.t_ns - present.t_ns >= RENEWAL_NS
    if not _has_shifted(tare, present, is_load_bearing) and not is_renewal:
        return NO_TARE
    tare = recent.remove_recovery(tare)
    shift_kpa = np.where(is_load_bearing, tare.baseline_kpa - present.baseline_kpa, 0.0)
    doubt = _explain_excess_shift(
        recent, tare, present, SHIFT_MAX_KPA, is_load_bearing, "the last tare"
    )
    if doubt is None and last_manual is not None:
        doubt = _explain_excess_shift(
            recent,
            tare,
            last_manual,
            TOTAL_SHIFT_MAX_KPA,
            is_load_bearing,
            "the last tare by hand",
        )
    if doubt is not None:
        return FlightTareResult(rejection=doubt)
    since_s = (tare.t_ns - present.t_ns) * 1e-9
    if (np.abs(shift_kpa) > SHIFT_RATE_MAX_KPA_PER_S * since_s).any():
        return NO_TARE  # perhaps in a minute
    has_shifted = _has_shifted(tare, present, is_load_bearing)
    if not has_shifted and not is_renewal:
        return NO_TARE
    most = int(np.argmax(np.abs(shift_kpa)))
    change = (
        f"{serials[most]} {shift_kpa[most]:+.2f} kPa from the tare before"
        if has_shifted
        else f"nothing has moved in {since_s / 60:.0f} min"
    )
    reason = f"automatic, foot in the air; {change}"
    return FlightTareResult(replace(tare, source="flight"), reason)


def _has_shifted(tare: Tare, present: Tare, is_load_bearing: Bools) -> bool:
    """Return whether a load-bearing tile's baseline has moved by more than chance."""
    sigma_kpa = np.hypot(tare.baseline_sigma_kpa, present.baseline_sigma_kpa)
    shift_kpa = np.abs(tare.baseline_kpa - present.baseline_kpa)
    limit_kpa = np.maximum(SHIFT_MIN_KPA, SHIFT_MIN_SIGMAS * sigma_kpa)
    return bool((shift_kpa > limit_kpa)[is_load_bearing].any())


def propose_first_tare_between_steps(recent: TareFrames) -> FlightTareResult:
    """Propose the first tare of a stream, if the foot has certainly been lifted.

    It has to have been loaded in these seconds and to be off the ground at their end, every tile
    near its rig baseline: a lightly loaded foot is quiet and near its baseline as well.
    """
    if not recent.has_rig_baselines or not len(recent.frames):
        return NO_TARE
    try:
        tare = compute_newest_unloaded_tare(recent, present=None)
    except TareError:
        return NO_TARE
    off_kpa = np.abs(tare.baseline_kpa - recent.rig_baseline_kpa)
    above_kpa = recent.kpa - tare.baseline_kpa
    # A sum over the foot, and for a tenth of a second: an outlier is no step.
    steps = np.nansum(np.maximum(above_kpa, 0.0), axis=1) > LOADED_KPA * np.sqrt(
        len(recent.serials)
    )
    stepped_ns = steps.mean() * float(recent.since_ns[-1])
    if (off_kpa > NEAR_BASELINE_KPA).any() or stepped_ns < RECOVERY_NS:
        return NO_TARE
    return FlightTareResult(
        replace(recent.remove_recovery(tare), source="flight"),
        "automatic, between two steps; there was none yet",
    )


def _explain_excess_shift(
    recent: TareFrames,
    tare: Tare,
    other: Tare,
    bound_kpa: float,
    is_load_bearing: Bools,
    which: str,
) -> str | None:
    """Return the reason why a baseline is too far from another one; None if it is near."""
    warming_k = compute_warming_k(other, tare.temperature_raw_counts, recent.counts_per_kelvin)
    explained_kpa = compute_sealed_gas_shift_kpa(other, warming_k)
    shift_kpa = tare.baseline_kpa - other.baseline_kpa
    excess_kpa = np.abs(shift_kpa - explained_kpa) - THERMAL_SHIFT_UNCERTAINTY * np.abs(
        explained_kpa
    )
    excess_kpa = np.where(is_load_bearing, excess_kpa, -np.inf)
    worst = int(np.argmax(excess_kpa))
    if excess_kpa[worst] <= bound_kpa:
        return None
    return (
        f"tile {recent.serials[worst]} reads {shift_kpa[worst]:+.2f} kPa against {which}, of which "
        f"{abs(warming_k[worst]):.1f} K explain {abs(explained_kpa[worst]):.2f} kPa: a light load, "
        "or a baseline that has moved. If the foot is in the air, tare by hand"
    )
