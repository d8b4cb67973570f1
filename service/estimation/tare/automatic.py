"""The automatic tare: keeps a true baseline true while the stream runs, and tares no load away.

A load that builds up slowly looks like a dome that warms up slowly. What tells them apart is the
chip's own temperature, and what bounds the mistake is how far a baseline may be moved without it:
by `NEAR_KPA` at once, `APART_NS` apart, and by `FAR_KPA` in all since the last tare by hand.
However slowly a load comes, no more of it is tared away than that: half a newton on a tile.

It is taken while the stream runs, from the newest unloaded interval among the frames just seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Bools, Times
from devices.errors import TareError
from devices.frames import NOT_READ, FrameBatch
from service.estimation.tare.tare import Tare, expected_shift_kpa, warmer_k
from service.estimation.tare.unloaded import (
    FRAMES_MIN,
    LOADED_KPA,
    NEAR_BASELINE_KPA,
    TareFrames,
    lowest,
    window_begins,
)

LOOK_BACK_NS = 10_000_000_000  # a foot that walks is in the air within that time
WINDOW_NS = 250_000_000  # fits into the flight of a hop, and holds enough readings
WARMING_COUNTS = 4.0
"""0.75 K: the gas may be that far from its chip, a quarter of a kilopascal or half a newton."""
WINDOW_MAX_NS = 1_000_000_000
"""Longest window, for arrays so slow that a shorter one would hold too few frames."""


def newest_unloaded_tare(
    seen: TareFrames, *, present: Tare | None, bears: Bools | None = None
) -> Tare:
    """The tare from the newest unloaded window of the frames seen.

    Of all windows in which every tile is quiet and still, those count in which no tile is higher
    than in the lowest of them, nor far above the present tare or, without one, the bench. The
    newest of these is taken.

    Args:
        seen: the last `LOOK_BACK_NS` of the stream, in order.
        present: the tare now in force.
        bears: (tiles,), False for bare tiles, which follow the weather; None: all bear load.

    Raises:
        TareError: the foot was loaded or moved all the time, or a tile gave no readings.
    """
    frames, since_ns = seen.frames, seen.since_ns
    there = np.isfinite(seen.kpa).any(axis=0)
    if not there.all():
        silent = [seen.serials[i] for i in np.flatnonzero(~there)]
        raise TareError(
            f"tile {', '.join(silent)} gave no readings in the last seconds",
            remedy="Plug it in, or take it out of the scene",
        )
    if len(frames) < FRAMES_MIN:
        raise TareError(f"only {len(frames)} frames have come", expected=f"at least {FRAMES_MIN}")
    usual_kpa = seen.bench_noise_kpa
    if present is not None:
        usual_kpa = np.where(np.isnan(usual_kpa), present.noise_kpa, usual_kpa)
    floor_kpa = seen.rounding_kpa(np.nanmedian(frames.tadc, axis=0))
    steps_kpa = np.maximum(seen.step_noise_kpa, floor_kpa)
    usual_kpa = np.where(np.isnan(usual_kpa), steps_kpa, usual_kpa)
    window_ns = _window_ns(since_ns)
    last_ns = int(since_ns[-1]) - window_ns
    begins_ns = window_begins(since_ns, last_ns, -(-window_ns // 4), window_ns)
    begins_ns = begins_ns[begins_ns <= last_ns][::-1]
    firsts = np.searchsorted(since_ns, begins_ns)
    ends = np.searchsorted(since_ns, begins_ns + window_ns, side="right")
    windows = seen.quiet_windows(zip(firsts.tolist(), ends.tolist(), strict=True), usual_kpa)
    if not windows:
        raise TareError(
            "the foot moved or was loaded all the time in the last seconds",
            expected=f"{WINDOW_NS / 1e9:g} s at rest in the air",
            remedy="Lift the foot, hold it still for a second, and tare again",
        )
    low = lowest(windows)
    if not low:
        raise TareError(
            "no tile was unloaded while all others were, in the last seconds",
            remedy="Lift the whole foot, hold it still for a second, and tare again",
        )
    tare = seen.tare(low[0].rows, "unloaded")
    if present is not None:
        _refuse_above(tare, present, seen.serials, bears)
    _refuse_warming(frames, tare, seen.serials)
    seen.refuse_loaded(tare)
    seen.refuse_stuck(tare, low[0].rows)
    return tare


def _window_ns(since_ns: Times) -> int:
    enough_ns = 1.25 * FRAMES_MIN * float(np.median(np.diff(since_ns)))
    return int(min(max(WINDOW_NS, enough_ns), WINDOW_MAX_NS))


def _refuse_warming(frames: FrameBatch, tare: Tare, serials: tuple[str, ...]) -> None:
    """Refuse a tare while a chip's temperature changes: its gas lags by seconds."""
    tadc = np.where(frames.tadc == NOT_READ, np.nan, frames.tadc.astype(np.float64))
    since_ns = frames.t_ns - frames.t_ns[0]
    begin = tadc[since_ns <= WINDOW_NS]
    known = np.isfinite(begin).any(axis=0)
    moved = np.zeros(len(serials))
    moved[known] = np.abs(np.nanmean(begin[:, known], axis=0) - tare.tadc_counts[known])
    worst = int(np.argmax(np.nan_to_num(moved)))
    if moved[worst] > WARMING_COUNTS:
        raise TareError(
            f"the temperature of tile {serials[worst]} has moved by {moved[worst]:.0f} counts in "
            "the last seconds, and the gas in its dome is still behind",
            expected=f"at most {WARMING_COUNTS:g} counts in {LOOK_BACK_NS / 1e9:g} s",
            remedy="Wait for half a minute and tare again",
        )


def _refuse_above(
    tare: Tare,
    present: Tare,
    serials: tuple[str, ...],
    bears: Bools | None,
) -> None:
    rise_kpa = tare.baseline_kpa - present.baseline_kpa
    if bears is not None:
        rise_kpa = np.where(bears, rise_kpa, -np.inf)
    worst = int(np.argmax(rise_kpa))
    if rise_kpa[worst] > NEAR_BASELINE_KPA:
        raise TareError(
            f"tile {serials[worst]} reads {rise_kpa[worst]:.2f} kPa more than at the last tare: "
            "the foot seems to be loaded",
            expected=f"at most {NEAR_BASELINE_KPA} kPa, as 5 K of warming give",
            remedy="Lift the foot and tare again; if it really has warmed up so much, undo the "
            "last tare first",
        )


APART_NS = 60_000_000_000
"""Two automatic tares are at least a minute apart."""
RATE_KPA_PER_S = 0.005
"""A baseline is never moved faster: a kelvin a minute, which is what a dome does in the sun."""
NEAR_KPA = 0.15
"""How far a baseline may be moved at once beyond what the temperature explains: 0.3 N on a tile,
the noise of a single reading."""
FAR_KPA = 0.25
"""Limit of the whole shift since the last tare that was not automatic: half a newton."""
EXPLAINED_PART = 0.5
"""Gas and chip do not warm at once, and the wall gives way: half of what is explained is open."""
SETTLE_NS = 100_000_000
"""How long the rubber recovers after a contact before a window may begin."""
CONFIRM_NS = 900_000_000_000
"""If nothing has moved, the tare is renewed only after this, long before it counts as old."""
MOVED_SIGMAS = 4.0  # of both tares: less may be chance
MOVED_MIN_KPA = 0.02
"""Less than this is not worth an entry in the history."""


@dataclass(frozen=True)
class Look:
    """What a look at the last seconds has found.

    Attributes:
        tare: to be put in force, and `reason` says why; None if the one in force is good.
        reason: in words, for the history.
        doubt: the foot seems to be in the air, and the baseline does not fit: why it was left.
    """

    tare: Tare | None = None
    reason: str = ""
    doubt: str | None = None


NOTHING = Look()


def look_in_flight(
    seen: TareFrames,
    *,
    present: Tare,
    anchor: Tare | None,
    free_since_t_ns: int,
    bears: Bools | None = None,
) -> Look:
    """Decide whether the baseline should follow the readings of a foot in the air.

    Args:
        seen: the last `LOOK_BACK_NS` of the stream, in order.
        present: the tare in force.
        anchor: the last tare that was not automatic; None without one.
        free_since_t_ns: since when there has been no contact, nor any doubt about it.
        bears: (tiles,), False for bare tiles, which follow the weather and no load; None: all do.
    """
    frames, serials = seen.frames, seen.serials
    if bears is None:
        bears = np.ones(len(serials), dtype=bool)
    if not len(frames) or frames.t_ns[-1] - free_since_t_ns < SETTLE_NS + WINDOW_NS:
        return NOTHING
    try:
        tare = newest_unloaded_tare(seen, present=present, bears=bears)
    except TareError:  # it moves, a tile is silent, or it bears a load: no flight
        return NOTHING
    begin_t_ns = int(frames.t_ns[0]) + round(tare.begin_s * 1e9)
    if begin_t_ns < free_since_t_ns + SETTLE_NS or tare.t_ns - present.t_ns < APART_NS:
        return NOTHING
    shift_kpa = np.where(bears, tare.baseline_kpa - present.baseline_kpa, 0.0)
    doubt = _too_far(tare, present, NEAR_KPA, serials, bears, "the last tare")
    if doubt is None and anchor is not None:
        doubt = _too_far(tare, anchor, FAR_KPA, serials, bears, "the last tare by hand")
    if doubt is not None:
        return Look(doubt=doubt)
    since_s = (tare.t_ns - present.t_ns) * 1e-9
    if (np.abs(shift_kpa) > RATE_KPA_PER_S * since_s).any():
        return NOTHING  # perhaps in a minute
    sigma_kpa = np.hypot(tare.baseline_sigma_kpa, present.baseline_sigma_kpa)
    moved = np.abs(shift_kpa) > np.maximum(MOVED_MIN_KPA, MOVED_SIGMAS * sigma_kpa)
    if not moved.any() and tare.t_ns - present.t_ns < CONFIRM_NS:
        return NOTHING
    most = int(np.argmax(np.abs(shift_kpa)))
    reason = (
        f"in flight; {serials[most]} by {shift_kpa[most]:+.2f} kPa in {since_s / 60:.0f} min"
        if moved.any()
        else f"in flight; nothing has moved in {since_s / 60:.0f} min"
    )
    return Look(replace(tare, source="flight"), reason)


def first_in_flight(seen: TareFrames) -> Look:
    """A first tare without a request, if it cannot be a mistake.

    The foot has to have been loaded in these seconds and to be off the ground at their end, every
    tile near its baseline on the bench: a foot that stands light is quiet and near as well.
    """
    if not seen.has_bench or not len(seen.frames):
        return NOTHING
    try:
        tare = newest_unloaded_tare(seen, present=None)
    except TareError:
        return NOTHING
    off_kpa = np.abs(tare.baseline_kpa - seen.bench_kpa)
    above_kpa = seen.kpa - tare.baseline_kpa
    # A sum over the foot, and for a tenth of a second: an outlier is no step.
    steps = np.nansum(np.maximum(above_kpa, 0.0), axis=1) > LOADED_KPA * np.sqrt(len(seen.serials))
    stepped_ns = steps.mean() * float(seen.since_ns[-1])
    if (off_kpa > NEAR_BASELINE_KPA).any() or stepped_ns < SETTLE_NS:
        return NOTHING
    return Look(replace(tare, source="flight"), "in flight, between two steps; there was none yet")


def _too_far(
    tare: Tare,
    other: Tare,
    bound_kpa: float,
    serials: tuple[str, ...],
    bears: Bools,
    which: str,
) -> str | None:
    """Why a baseline has moved too far from another one to be believed."""
    warmer = np.nan_to_num(warmer_k(other, tare.tadc_counts), nan=0.0)
    explained_kpa = expected_shift_kpa(other, warmer)
    shift_kpa = tare.baseline_kpa - other.baseline_kpa
    excess_kpa = np.abs(shift_kpa - explained_kpa) - EXPLAINED_PART * np.abs(explained_kpa)
    excess_kpa = np.where(bears, excess_kpa, -np.inf)
    worst = int(np.argmax(excess_kpa))
    if excess_kpa[worst] <= bound_kpa:
        return None
    return (
        f"tile {serials[worst]} reads {shift_kpa[worst]:+.2f} kPa against {which}, of which "
        f"{abs(warmer[worst]):.1f} K explain {abs(explained_kpa[worst]):.2f} kPa: a light load, or "
        "a baseline that has moved. If the foot is in the air, tare by hand"
    )
