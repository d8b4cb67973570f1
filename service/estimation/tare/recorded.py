"""The tare of a recording, from its beginning.

It comes from an interval the user names, else from frames marked as lead, else from an interval
that can be recognised as unloaded; else there is none, and that is an error, because a wrong
baseline is a wrong force that looks right.
"""

from __future__ import annotations

import numpy as np

from devices.chips.compensation import Compensation
from devices.errors import TareError
from devices.frames import FrameBatch, FrameStatus
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded import NEAR_BASELINE_KPA, TareFrames, lowest

RECOGNISE_WITHIN_NS = 60_000_000_000
"""An unloaded interval is looked for in the first minute of a recording."""
WINDOW_NS = 500_000_000  # longer than in flight: a recording begins at rest


def take_tare(
    frames: FrameBatch,
    compensation: Compensation,
    calibration: Calibration,
    serials: tuple[str, ...],
    *,
    interval_s: tuple[float, float] | None = None,
) -> Tare:
    """The tare of a recording from its beginning `frames`.

    Args:
        frames: frames from the first of the recording on.
        compensation: of the array's chips.
        calibration: of its tiles, whose bench baselines tell an unloaded tile.
        serials: of the tiles, in order.
        interval_s: the user's interval, in seconds from the first frame.

    Raises:
        TareError: the interval holds too few readable frames, or none can be recognised.
    """
    if interval_s is not None:
        begin_s, end_s = interval_s
        seen = TareFrames(frames, compensation, calibration, serials)
        t_s = seen.since_ns * 1e-9
        tare = seen.tare((t_s >= begin_s) & (t_s <= end_s), "interval")
        seen.refuse_loaded(tare)
        return tare
    lead = np.logical_and.accumulate((frames.frame_status & FrameStatus.LEAD) != 0)
    if lead[0]:
        seen = TareFrames(frames, compensation, calibration, serials)
        tare = seen.tare(lead, "lead")
        seen.refuse_loaded(tare)
        seen.refuse_stuck(tare, lead)
        return tare
    # How many frames are at hand must not matter, only which ones a recording begins with.
    last_ns = frames.t_ns[0] + RECOGNISE_WITHIN_NS
    frames = frames.rows(0, int(np.searchsorted(frames.t_ns, last_ns, side="right")))
    seen = TareFrames(frames, compensation, calibration, serials)
    rows = _recognised(seen, calibration)
    tare = seen.tare(rows, "recognised")
    seen.refuse_stuck(tare, rows)
    return tare


def _recognised(seen: TareFrames, calibration: Calibration) -> slice:
    """Rows of the first half second with every tile quiet, still, low and near its bench baseline.

    Raises:
        TareError: there is none, or the bench baselines are not known.
    """
    if not seen.has_bench:
        raise TareError(
            f"calibration {calibration.name} does not say where an unloaded tile lies",
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        )
    # A bare tile is not calibrated: it may read anything, with the noise that it shows.
    noise_kpa = np.where(seen.calibrated, seen.bench_noise_kpa, seen.step_noise_kpa)
    begins_ns = np.arange(0, int(seen.since_ns[-1]) + 1, WINDOW_NS // 2)
    firsts, ends = np.searchsorted(seen.since_ns, [begins_ns, begins_ns + WINDOW_NS])
    windows = seen.quiet_windows(zip(firsts.tolist(), ends.tolist(), strict=True), noise_kpa)
    near = [
        window
        for window in windows
        if not (np.abs(window.mean_kpa - seen.bench_kpa) >= NEAR_BASELINE_KPA).any()
    ]
    low = lowest(near)
    if not low:
        raise TareError(
            "no interval can be recognised as unloaded",
            expected=f"{WINDOW_NS / 1e9:g} s in which every tile is quiet and within "
            f"{NEAR_BASELINE_KPA} kPa of its baseline on the bench",
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        )
    return low[0].rows
