"""A tare while the stream runs: the newest unloaded interval among the frames just seen.

The foot is in the air now and then, or is lifted before the button is pressed; either way some
quarter of a second of the last seconds was without load. If none can be recognised, there is no
tare, because a tare under load makes every force after it too small.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Bools, Times
from devices.errors import TareError
from devices.frames import NOT_READ, FrameBatch
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded import FRAMES_MIN, NEAR_BASELINE_KPA, TareFrames, lowest

LOOK_BACK_NS = 10_000_000_000  # a foot that walks is in the air within that time
WINDOW_NS = 250_000_000  # fits into the flight of a hop, and holds enough readings
WARMING_COUNTS = 4.0
"""0.75 K: the gas may be that far from its chip, a quarter of a kilopascal or half a newton."""
WINDOW_MAX_NS = 1_000_000_000
"""A window is longer if an array is so slow that it would hold too few frames, up to this."""


def tare_in_flight(seen: TareFrames, *, present: Tare | None, bears: Bools | None = None) -> Tare:
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
    begins_ns = np.arange(int(since_ns[-1]) - window_ns, -1, -window_ns // 4)
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
    """While a chip's temperature moves, its gas is seconds behind, and no baseline is one."""
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
