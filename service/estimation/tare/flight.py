"""A tare while the stream runs: the newest unloaded interval among the frames just seen.

The foot is in the air now and then, or somebody lifts it and presses the button; either way some
quarter of a second of the last seconds was without load. If none can be told to be, there is no
tare, because a tare under load makes every force after it too small.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Bools, Times
from devices.chips.compensation import Compensation
from devices.errors import TareError
from devices.frames import NOT_READ, FrameBatch
from devices.temperature import hold_temperature
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import (
    FRAMES_MIN,
    NEAR_BASELINE_KPA,
    QUIET,
    STILL_SIGMAS,
    Tare,
    refuse_loaded,
    refuse_stuck,
    tare_from_rows,
)

LOOK_BACK_NS = 10_000_000_000
WINDOW_NS = 250_000_000
WARMING_COUNTS = 4.0
"""0.75 K: the gas may be that far from its chip, a quarter of a kilopascal or half a newton."""
WINDOW_MAX_NS = 1_000_000_000
"""A window is longer if an array is so slow that it would hold too few frames, up to this."""


def tare_in_flight(
    frames: FrameBatch,
    compensation: Compensation,
    calibration: Calibration,
    serials: tuple[str, ...],
    *,
    present: Tare | None,
    bears: Bools | None = None,
) -> Tare:
    """The tare from the newest unloaded window of `frames`.

    Of all windows in which every tile is quiet and still, those count in which no tile is higher
    than in the lowest of them, nor far above the present tare or, without one, the bench: a foot
    that stands still is quiet too, but presses. The newest of these is taken.

    Args:
        frames: the last `LOOK_BACK_NS` of the stream, in order.
        compensation: of the array's chips.
        calibration: of its tiles, whose bench baselines tell an unloaded tile.
        serials: of the tiles, in order.
        present: the tare now in force.
        bears: (tiles,), False for bare tiles, which follow the weather; None: all bear load.

    Raises:
        TareError: the foot was loaded or moved all the time, or a tile gave no readings.
    """
    frames, _ = hold_temperature(frames)
    kpa = compensation.readable_kpa(frames)
    silent = [s for s, column in zip(serials, kpa.T, strict=True) if not np.isfinite(column).any()]
    if silent:
        raise TareError(
            f"tile {', '.join(silent)} gave no readings in the last seconds",
            remedy="Plug it in, or take it out of the scene",
        )
    if len(frames) < FRAMES_MIN:
        raise TareError(f"only {len(frames)} frames have come", expected=f"at least {FRAMES_MIN}")
    entries = [calibration.find(serial) for serial in serials]
    bench_kpa = np.array([e.baseline_kpa if e else None for e in entries], dtype=np.float64)
    usual_kpa = np.array([e.noise_kpa if e else None for e in entries], dtype=np.float64)
    if present is not None:
        usual_kpa = np.where(np.isnan(usual_kpa), present.noise_kpa, usual_kpa)
    # Else from what changes between two frames, which a slow motion hardly does.
    steps_kpa = np.nanstd(np.diff(kpa, axis=0), axis=0) / np.sqrt(2.0)
    floor_kpa = compensation.rounding_kpa(np.nanmedian(frames.tadc, axis=0))
    usual_kpa = np.where(np.isnan(usual_kpa), np.maximum(steps_kpa, floor_kpa), usual_kpa)
    since_ns = frames.t_ns - frames.t_ns[0]
    window_ns = _window_ns(since_ns)
    windows = []
    for begin_ns in range(int(since_ns[-1]) - window_ns, -1, -window_ns // 4):
        first = int(np.searchsorted(since_ns, begin_ns))
        end = int(np.searchsorted(since_ns, begin_ns + window_ns, side="right"))
        window_kpa, n = kpa[first:end], end - first
        if n < FRAMES_MIN or not np.isfinite(window_kpa).all():
            continue
        mean_kpa, noise_kpa = window_kpa.mean(axis=0), window_kpa.std(axis=0, ddof=1)
        drift_kpa = window_kpa[: n // 2].mean(axis=0) - window_kpa[n // 2 :].mean(axis=0)
        mean_sigma_kpa = usual_kpa / np.sqrt(n)
        quiet = noise_kpa < QUIET * usual_kpa
        still = np.abs(drift_kpa) < STILL_SIGMAS * 2.0 * mean_sigma_kpa
        if (quiet & still).all():
            windows.append(((first, end), mean_kpa, mean_sigma_kpa))
    if not windows:
        raise TareError(
            "the foot moved or was loaded all the time in the last seconds",
            expected=f"{WINDOW_NS / 1e9:g} s at rest in the air",
            remedy="Lift the foot, hold it still for a second, and tare again",
        )
    lowest_kpa = np.min([mean_kpa for _, mean_kpa, _ in windows], axis=0)
    low = [
        span for span, mean_kpa, sigma_kpa in windows if _as_low(mean_kpa, lowest_kpa, sigma_kpa)
    ]
    if not low:
        raise TareError(
            "no tile was unloaded while all others were, in the last seconds",
            remedy="Lift the whole foot, hold it still for a second, and tare again",
        )
    rows = np.zeros(len(frames), dtype=np.bool_)
    rows[slice(*low[0])] = True
    tare = tare_from_rows(frames, compensation, serials, rows, "unloaded")
    if present is not None:
        _refuse_above(tare, present, serials, bears)
    _refuse_warming(frames, tare, serials)
    if np.isfinite(bench_kpa).any():
        refuse_loaded(tare, calibration, serials)
    refuse_stuck(frames, compensation, calibration, serials, rows)
    return tare


def _window_ns(since_ns: Times) -> int:
    enough_ns = 1.25 * FRAMES_MIN * float(np.median(np.diff(since_ns)))
    return int(min(max(WINDOW_NS, enough_ns), WINDOW_MAX_NS))


def _as_low(mean_kpa: np.ndarray, lowest_kpa: np.ndarray, sigma_kpa: np.ndarray) -> bool:
    return bool((mean_kpa < lowest_kpa + STILL_SIGMAS * np.sqrt(2.0) * sigma_kpa).all())


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
