"""The tare: each tile's baseline and noise, from an interval without load.

It comes from an interval the user names, else from frames marked as lead, else from an interval
that can be recognised as unloaded; else there is none, and that is an error, because a wrong
baseline is a wrong force that looks right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from devices.arrays import Bools, Floats
from devices.chips.compensation import Compensation
from devices.errors import TareError
from devices.frames import FrameBatch, FrameStatus
from devices.temperature import hold_temperature
from service.estimation.calibration import Calibration

FRAMES_MIN = 20
RECOGNISE_WITHIN_NS = 60_000_000_000
"""An unloaded interval is looked for in the first minute of a recording."""
WINDOW_NS = 500_000_000
NEAR_BASELINE_KPA = 1.5
"""How far an unloaded bubble may be from its baseline on the bench: 5 K, by p0 / T0."""
LOADED_KPA = 3.0
"""A tile this far above its bench baseline, 10 K by p0 / T0, is not taken for an unloaded one, even
if the user or a flag says so."""
QUIET = 1.5
"""An unloaded tile's readings scatter at most so much more than on the bench."""
STILL_SIGMAS = 4.0
"""The halves of a window, and the window and the lowest one, differ by no more than chance does."""

STUCK_COUNTS = 0.5
"""A part that scatters by more than so many counts does not read the same one twenty times."""

Source = Literal["interval", "lead", "recognised", "unloaded", "flight"]


@dataclass(frozen=True)
class Tare:
    """Baselines with their uncertainty; arrays over tiles.

    Attributes:
        baseline_kpa: absolute pressure unloaded.
        baseline_sigma_kpa: its standard uncertainty.
        noise_kpa: standard deviation of a single reading.
        tadc_counts: mean temperature counts; NaN in tares of older versions, which kept none.
        t_ns: instant at which the interval ended, in UTC.
        begin_s: begin of the interval, in seconds from the first frame.
        end_s: its end.
        frames: number of frames it was taken from.
        source: how the interval was found.
    """

    baseline_kpa: Floats
    baseline_sigma_kpa: Floats
    noise_kpa: Floats
    tadc_counts: Floats
    t_ns: int
    begin_s: float
    end_s: float
    frames: int
    source: Source

    def as_dict(self) -> dict[str, Any]:
        """For JSON, which has no NaN: `None`."""
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            name: [None if np.isnan(x) else x for x in value.tolist()]
            if isinstance(value, np.ndarray)
            else value
            for name, value in content.items()
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, tiles: int) -> Tare:
        """From JSON, for an array of `tiles` tiles.

        Raises:
            TareError: it is no tare, or of another number of tiles.
        """
        try:
            values: dict[str, Any] = {"source": str(content["source"])}
            values |= {name: int(content[name]) for name in ("t_ns", "frames")}
            values |= {name: float(content[name]) for name in ("begin_s", "end_s")}
            for name in ("baseline_kpa", "baseline_sigma_kpa", "noise_kpa"):
                values[name] = np.array(content[name], dtype=np.float64)
                if values[name].shape != (tiles,) or not np.isfinite(values[name]).all():
                    raise ValueError(f"{name} is not that of {tiles} tiles")  # noqa: TRY301  # caught with the others
            counts = content.get("tadc_counts") or [None] * tiles
            values["tadc_counts"] = np.array(counts, dtype=np.float64)  # None becomes NaN
            if values["tadc_counts"].shape != (tiles,):
                raise ValueError(f"tadc_counts are not those of {tiles} tiles")  # noqa: TRY301  # caught with the others
            return cls(**values)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise TareError(f"a recorded tare is not readable: {error}") from error


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
    frames, _ = hold_temperature(frames)
    t_s = (frames.t_ns - frames.t_ns[0]) * 1e-9
    if interval_s is not None:
        begin_s, end_s = interval_s
        rows = (t_s >= begin_s) & (t_s <= end_s)
        tare = tare_from_rows(frames, compensation, serials, rows, "interval")
        return refuse_loaded(tare, calibration, serials)
    lead = np.logical_and.accumulate((frames.frame_status & FrameStatus.LEAD) != 0)
    if lead[0]:
        tare = tare_from_rows(frames, compensation, serials, lead, "lead")
        refuse_loaded(tare, calibration, serials)
        refuse_stuck(frames, compensation, calibration, serials, lead)
        return tare
    # How many frames are at hand must not matter, only which ones a recording begins with.
    frames = frames.rows(
        0, int(np.searchsorted(frames.t_ns, frames.t_ns[0] + RECOGNISE_WITHIN_NS, side="right"))
    )
    rows = _recognise(frames, compensation, calibration, serials)
    refuse_stuck(frames, compensation, calibration, serials, rows)
    return tare_from_rows(frames, compensation, serials, rows, "recognised")


def tare_from_rows(
    frames: FrameBatch,
    compensation: Compensation,
    serials: tuple[str, ...],
    rows: Bools,
    source: Source,
) -> Tare:
    """The tare from those `frames` that `rows` marks, a boolean array over them.

    Raises:
        TareError: a tile has fewer than `FRAMES_MIN` readable frames among them.
    """
    kpa = compensation.readable_kpa(frames)[rows]
    readable = np.isfinite(kpa).sum(axis=0)
    for serial, count in zip(serials, readable, strict=True):
        if count < FRAMES_MIN:
            raise TareError(
                f"tile {serial} has {count} readable frames in the interval",
                expected=f"at least {FRAMES_MIN}",
                remedy="Name another interval with --tare-s BEGIN,END",
            )
    # A perfectly quiet reading is still rounded to a count.
    tadc = np.where(np.isfinite(kpa), frames.tadc[rows], np.nan)
    tadc_counts = np.nanmean(tadc, axis=0)
    floor_kpa = compensation.rounding_kpa(tadc_counts)
    noise_kpa = np.maximum(np.nanstd(kpa, axis=0, ddof=1), floor_kpa)
    t_s = (frames.t_ns[rows] - frames.t_ns[0]) * 1e-9
    return Tare(
        baseline_kpa=np.nanmean(kpa, axis=0),
        baseline_sigma_kpa=noise_kpa / np.sqrt(readable),
        noise_kpa=noise_kpa,
        tadc_counts=tadc_counts,
        t_ns=int(frames.t_ns[rows][-1]),
        begin_s=float(t_s[0]),
        end_s=float(t_s[-1]),
        frames=int(rows.sum()),
        source=source,
    )


def refuse_loaded(tare: Tare, calibration: Calibration, serials: tuple[str, ...]) -> Tare:
    """Refuse a tare under load, which would make every force after it too small.

    A colder tile lies lower than on the bench, and no load does that, so only above is refused.
    """
    for serial, baseline_kpa in zip(serials, tare.baseline_kpa, strict=True):
        entry = calibration.find(serial)
        bench_kpa = entry.baseline_kpa if entry is not None else None
        if bench_kpa is not None and baseline_kpa > bench_kpa + LOADED_KPA:
            raise TareError(
                f"tile {serial} reads {baseline_kpa:.2f} kPa in the interval, and "
                f"{bench_kpa:.2f} kPa unloaded on the bench: it seems to be loaded",
                expected=f"at most {LOADED_KPA} kPa more",
                remedy="Name an unloaded interval with --tare-s BEGIN,END, or calibrate at this "
                "temperature",
            )
    return tare


def refuse_stuck(
    frames: FrameBatch,
    compensation: Compensation,
    calibration: Calibration,
    serials: tuple[str, ...],
    rows: Bools,
) -> None:
    """Refuse a baseline of readings that are all the same, unless the bench saw no noise either.

    Raises:
        TareError: a tile gave the same count again and again, as a part does that hangs.
    """
    readable = np.isfinite(compensation.readable_kpa(frames)[rows])
    padc = np.where(readable, frames.padc[rows], np.nan)
    tadc = np.where(readable, frames.tadc[rows], np.nan)
    count_kpa = np.sqrt(12.0) * compensation.rounding_kpa(np.nanmean(tadc, axis=0))
    spread = np.nanmax(padc, axis=0) - np.nanmin(padc, axis=0)
    for i, serial in enumerate(serials):
        entry = calibration.find(serial)
        noise_kpa = entry.noise_kpa if entry is not None else None
        quiet_by_nature = noise_kpa is not None and noise_kpa <= STUCK_COUNTS * count_kpa[i]
        if spread[i] == 0.0 and not quiet_by_nature:
            raise TareError(
                f"tile {serial} gave {int(np.nanmin(padc[:, i]))} counts "
                f"{int(np.isfinite(padc[:, i]).sum())} times and nothing else",
                expected="readings that scatter, as those of a part that converts do",
                remedy="It seems to hang: unplug it and plug it in again, then tare",
            )


def _recognise(
    frames: FrameBatch,
    compensation: Compensation,
    calibration: Calibration,
    serials: tuple[str, ...],
) -> Bools:
    """Rows of half a second without load.

    Of all windows in which every tile is quiet, still and near its bench baseline, those count in
    which no tile is higher than in the lowest of them: a foot that stands still is quiet too, but
    presses. The first of these is taken.
    """
    entries = [calibration.find(serial) for serial in serials]
    known = [entry for entry in entries if entry is not None]
    if not known or any(e.baseline_kpa is None or e.noise_kpa is None for e in known):
        raise TareError(
            f"calibration {calibration.name} does not say where an unloaded tile lies",
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        )
    kpa = compensation.readable_kpa(frames)
    # A bare tile is not calibrated: it may read anything, with the noise that it shows.
    steps_kpa = np.nanstd(np.diff(kpa, axis=0), axis=0) / np.sqrt(2.0)
    expected_kpa = np.array(
        [np.nan if e is None else e.baseline_kpa for e in entries], dtype=np.float64
    )
    noise_kpa = np.array(
        [s if e is None else e.noise_kpa for e, s in zip(entries, steps_kpa, strict=True)],
        dtype=np.float64,
    )
    since_ns = frames.t_ns - frames.t_ns[0]
    found: list[tuple[Bools, Floats, Floats]] = []
    for begin_ns in range(0, int(since_ns[-1]) + 1, WINDOW_NS // 2):
        rows = (since_ns >= begin_ns) & (since_ns < begin_ns + WINDOW_NS)
        window_kpa = kpa[rows]
        n = len(window_kpa)
        if n < FRAMES_MIN or not np.isfinite(window_kpa).all():
            continue
        mean_kpa = window_kpa.mean(axis=0)
        mean_sigma_kpa = noise_kpa / np.sqrt(n)
        drift_kpa = window_kpa[: n // 2].mean(axis=0) - window_kpa[n // 2 :].mean(axis=0)
        near = ~(np.abs(mean_kpa - expected_kpa) >= NEAR_BASELINE_KPA)
        quiet = window_kpa.std(axis=0, ddof=1) < QUIET * noise_kpa
        still = np.abs(drift_kpa) < STILL_SIGMAS * 2.0 * mean_sigma_kpa
        if (near & quiet & still).all():
            found.append((rows, mean_kpa, mean_sigma_kpa))
    lowest_kpa = np.min([mean_kpa for _, mean_kpa, _ in found], axis=0, initial=np.inf)
    for rows, mean_kpa, mean_sigma_kpa in found:
        if (mean_kpa < lowest_kpa + STILL_SIGMAS * np.sqrt(2.0) * mean_sigma_kpa).all():
            return rows
    raise TareError(
        "no interval can be recognised as unloaded",
        expected=f"{WINDOW_NS / 1e9:g} s in which every tile is quiet and within "
        f"{NEAR_BASELINE_KPA} kPa of its baseline on the bench",
        remedy="Name an unloaded interval with --tare-s BEGIN,END",
    )
