"""All that is watched of an array's tiles, with its constants and its state.

Before the models: words that repeat, and an edge below the chip's end. Behind them: what is left of
the baseline, by what the models say and by warmth that none of them corrects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Bools, Floats, Ints, Times
from devices.chips.compensation import Compensation
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare, expected_shift_kpa
from service.estimation.watch import baseline, clip, repeats, warmth
from service.estimation.watch.state import State

UNLOADED_SIGMAS = 4.0
"""Of a reading about the baseline: so near it, no load is seen."""


@dataclass(frozen=True)
class WatchState:
    """What the watch remembers; None before the first frames."""

    repeats: State | None = None
    clip: State | None = None
    baseline: State | None = None
    warmth: State | None = None


@dataclass(frozen=True)
class Watch:
    """Constants over an array's tiles.

    Attributes:
        bearing: (bearing tiles,), columns of the tiles that bear load.
        baseline_kpa: (tiles,), at the tare.
        end_kpa: (tiles,), absolute pressure behind which a chip may stand still, and is no tile
            that repeats itself.
        unloaded_kpa: (tiles,), so near the baseline no load is seen.
        bearing_kpa: (bearing tiles,) each: baselines, the same bound, and the noise of a reading.
        most: how often a word may repeat.
        even: (bearing tiles,), for `baseline.lost`.
        tare_counts: (bearing tiles,), `tadc` at the tare.
        kpa_per_count: (bearing tiles,), of warmth that no model corrects; None if one does.
    """

    bearing: Ints
    baseline_kpa: Floats
    end_kpa: Floats
    unloaded_kpa: Floats
    bearing_kpa: tuple[Floats, Floats, Floats]
    most: repeats.Limits
    even: Floats
    tare_counts: Floats
    kpa_per_count: Floats | None

    def readings(
        self, frames: FrameBatch, kpa: Floats, state: WatchState
    ) -> tuple[Bools, Floats | None, WatchState]:
        """Which readings are repeats, and above what pressure they may be clipped.

        Args:
            frames: n frames.
            kpa: their absolute pressures (n, tiles), NaN where there is none.
            state: from the frames before.

        Returns:
            (n, tiles); (n, bearing tiles), or None if nowhere; and the next state.
        """
        stuck, repeated = repeats.repeating(
            frames.padc,
            kpa,
            self.baseline_kpa,
            self.end_kpa,
            self.unloaded_kpa,
            self.most,
            repeats.at_rest(frames.tile_count) if state.repeats is None else state.repeats,
        )
        end_kpa, clipped = clip.end_of_range(
            kpa[:, self.bearing],
            *self.bearing_kpa,
            clip.at_rest(len(self.bearing)) if state.clip is None else state.clip,
        )
        return stuck, end_kpa, replace(state, repeats=repeated, clip=clipped)

    def warmed_kpa(
        self, frames: FrameBatch, t_ns: Times, state: WatchState
    ) -> tuple[Floats, WatchState]:
        """What the baselines have moved by since the tare and no model corrects, signed."""
        if self.kpa_per_count is None:
            return np.zeros(t_ns.shape), state
        before = warmth.at_rest(len(self.bearing)) if state.warmth is None else state.warmth
        tadc = frames.tadc[:, self.bearing]
        warmed_kpa, after = warmth.moved_kpa(
            tadc, self.tare_counts, self.kpa_per_count, t_ns, before
        )
        return warmed_kpa, replace(state, warmth=after)

    def lost_kpa(
        self,
        gauge_kpa: Floats,
        variance: Floats,
        warmed_kpa: Floats,
        t_ns: Times,
        state: WatchState,
    ) -> tuple[Floats, Bools, WatchState]:
        """How wrong each baseline may be by what is read; see `baseline.lost`."""
        before = baseline.at_rest(len(self.bearing)) if state.baseline is None else state.baseline
        lost_kpa, astray, after = baseline.lost(
            gauge_kpa, variance, warmed_kpa, t_ns, self.even, before
        )
        return lost_kpa, astray, replace(state, baseline=after)


def make_watch(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    chip_end_kpa: Floats,
    *,
    gas_known: Bools,
    warms: bool,
) -> Watch:
    """Work out the constants.

    Args:
        info: the array.
        calibration: of its tiles.
        tare: in force.
        chip_end_kpa: (bearing tiles,), absolute pressures that no chip is believed above.
        gas_known: (bearing tiles,), is a tile's gas corrected?
        warms: is there no model for the temperature?
    """
    tiles = info.tiles
    bearing = np.flatnonzero([not tile.reference for tile in tiles])
    end_kpa = np.full(len(tiles), np.inf)
    end_kpa[bearing] = chip_end_kpa
    counts = np.where(np.isfinite(tare.tadc_counts), tare.tadc_counts, 500.0)
    count_kpa = np.abs(Compensation(tiles).kpa_per_count(counts))
    # A lost tare has no noise; nothing is judged then, since no pressure is above its baseline.
    noise = np.zeros(len(tiles))
    np.divide(
        tare.noise_kpa, count_kpa, out=noise, where=(count_kpa > 0.0) & np.isfinite(tare.noise_kpa)
    )
    unloaded_kpa = UNLOADED_SIGMAS * np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    per_count = expected_shift_kpa(tare, np.ones(len(tiles)) / TADC_PER_KELVIN)[bearing]
    for at, column in enumerate(bearing):
        entry = calibration.find(tiles[column].serial)
        if entry is not None and entry.effects.temperature is not None:
            per_count[at] = entry.effects.temperature.kpa_per_k.value / TADC_PER_KELVIN
    return Watch(
        bearing=bearing,
        baseline_kpa=tare.baseline_kpa,
        end_kpa=end_kpa,
        unloaded_kpa=unloaded_kpa,
        bearing_kpa=(tare.baseline_kpa[bearing], unloaded_kpa[bearing], tare.noise_kpa[bearing]),
        most=repeats.make_limits(noise, info.nominal_rate_hz),
        even=np.where(gas_known, baseline.EVEN, baseline.EVEN_WITHOUT_GAS),
        tare_counts=tare.tadc_counts[bearing],
        kpa_per_count=per_count if warms else None,
    )
