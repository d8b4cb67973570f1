"""Everything an estimate needs to know before the first frame, worked out once.

A scene says which models it needs and only those are computed; what is not named costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints
from devices.chips.compensation import Compensation
from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.errors import CalibrationError, UsageError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import Parameter
from service.estimation.foot.contact import ContactRule
from service.estimation.foot.geometry import axes_rad, grid_indices, hull, lost_by_tilt
from service.estimation.ladder.chosen import MODELS, Ladder, make_ladder
from service.estimation.ladder.unseen import Unseen, make_unseen
from service.estimation.models import denoise
from service.estimation.tare.noise import left_by_mean
from service.estimation.tare.tare import Tare
from service.estimation.watch.watch import Watch, make_watch

CONTACT_ON_SIGMA = 5.0  # of the GRF unloaded: noise alone does not get there
CONTACT_OFF_SIGMA = 3.0  # lower than on, so that noise about a threshold does not chatter
CONTACT_MIN_NS = 10_000_000  # a shorter change is an outlier or a bounce
SIGMAS = 5.0
"""COP needs a GRF of so many sigma: below, the first-order variance of a ratio is not valid. And a
pressure so many sigma below the calibrated range is no noise."""
SUCTION_MAX_KPA = 10.0
"""No foot pulls at a dome like that, and 30 kelvins make less: a pressure so far below the baseline
is a count that wrapped and went on far, a torn dome or another fault, and no force."""
COP_SIGMA_MAX_M = 0.003  # a quarter of a dome: worse says nothing of where the load is
TARE_OLD_NS = 1_800_000_000_000
"""Half an hour: at the 0.3 kPa/K of a sealed bubble a degree in that time is half a newton."""
LAG_MAX_MS = 60_000.0  # so long are frames kept in memory
WARM_UP_TIMES = 5.0
"""Time constants that models run before what they give is used; less than a hundredth is left."""
WARM_UP_LEAST_S = 10.0
"""What has no time constant of its own: noise, contact, what holds for the last seconds."""
GAP = 1.5
"""A frame this many nominal periods after the one before comes after a gap."""


@dataclass(frozen=True)
class EstimationPlan:
    """Constants of one estimate of one stream; arrays over tiles. Made by `make_plan`."""

    info: ArrayInfo
    calibration: Calibration
    tare: Tare
    models: tuple[str, ...]
    lag_ns: int
    compensation: Compensation
    ladder: Ladder
    bearing: npt.NDArray[np.intp]
    """Columns of the tiles that bear load; arrays below are over these, unless stated."""
    references: npt.NDArray[np.intp]
    """Columns of bare reference tiles, which are in no sum."""
    baseline_kpa: Floats
    baseline_sigma_kpa: Floats
    noise_kpa: Floats
    noise_left: Floats
    """(bearing tiles, n), how much more of it an average of n readings leaves than of white."""
    late_ns: Ints
    """How much later a tile is sampled than its frames say."""
    late_sigma_s: Floats
    """Its standard uncertainty, every tile's own; ..."""
    late_common_s: Floats
    """... and what all tiles share of it."""
    chip_end_kpa: Floats
    """Absolute pressure above which a chip is not known to tell the pressure: the end of its rated
    range, or of what it told on the bench if that is more, or less because it told no more."""
    unseen: Unseen
    watch: Watch | None
    """None: nothing is watched, as benchmarks may want."""
    still_kpa: Floats
    """Standard deviation of a single unloaded reading about the true baseline."""
    bearing_m: Floats
    """(bearing tiles, 3)."""
    cop_measured: tuple[bool, bool]
    """Whether the tiles measure the centre of pressure along x and y; across a row they do not."""
    gain: Floats
    """What the ground puts on a tile's part of the foot for a newton of the dome's."""
    gain_sigma: Floats
    axis_rad: Floats
    """Angle of a tile's axis to the segment."""
    tilted: Floats
    """Part of a tile's force that may not be along the segment, for its axis is not."""
    shear: Parameter | None
    """Which way the ground pushes tiles that are not upright; None: not known."""
    hull: tuple[Floats, Floats]
    grid: tuple[Floats, Floats] | None
    contact: ContactRule
    assumed_scale: bool
    gap_ns: int
    cop_sigma_max_m: float = COP_SIGMA_MAX_M

    @property
    def waits(self) -> bool:
        """Does every frame wait for the next one, to tell an outlier?"""
        return self.ladder.denoise and self.lag_ns > 0

    @property
    def look_ns(self) -> int:
        """How far what comes later may be looked at.

        A frame that waits for the next one is not there yet when its instant is.
        """
        return self.lag_ns - 1 if self.waits else self.lag_ns


def make_plan(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    *,
    models: Sequence[str],
    lag_ms: float = 0.0,
) -> EstimationPlan:
    """Work out an estimate's constants.

    Args:
        info: the array.
        calibration: of all its tiles, or a preset for any.
        tare: of this recording.
        models: names of `MODELS`, in any order; `static` must be among them.
        lag_ms: look-ahead: estimates come this much later and know that much more.

    Raises:
        UsageError: an unknown model, no `static`, `ambient` without a bare tile, or a bad lag.
        CalibrationError: a bearing tile is not calibrated, or not for one of the models.
    """
    if not 0.0 <= lag_ms <= LAG_MAX_MS:
        raise UsageError(f"a look-ahead of {lag_ms} ms", expected=f"0 to {LAG_MAX_MS:g} ms")
    bearing = np.flatnonzero([not tile.reference for tile in info.tiles])
    if not len(bearing):
        raise UsageError("every tile of the array is a reference tile: nothing bears load")
    ladder = make_ladder(info, calibration, tare, models)
    entries = [calibration.of(info.tiles[i].serial) for i in bearing]
    for i, entry in zip(bearing, entries, strict=True):
        tile = info.tiles[i]
        if entry.coefficient_words not in (None, tile.coefficient_words):
            raise CalibrationError(
                f"tile {tile.serial} is not the part that was calibrated: its chip has the "
                f"coefficients {tile.coefficient_words}, the calibrated one "
                f"{entry.coefficient_words}",
                where=f"calibration {calibration.name} ({calibration.id})",
                remedy="Press this tile on the bench and calibrate it, or correct the serial",
            )
    positions_m = np.array([(tile.x_m, tile.y_m, tile.z_m) for tile in info.tiles])
    baseline_kpa = tare.baseline_kpa[bearing]
    chip_end_kpa = np.array(
        [_chip_end_kpa(*each) for each in zip(entries, baseline_kpa.tolist(), strict=True)]
    )
    still_kpa = np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)[bearing]
    unloaded_n = float(np.sqrt(((ladder.curves.slope_at_zero_n_per_kpa * still_kpa) ** 2).sum()))
    gains = [calibration.gain(info.tiles[i].serial) for i in bearing]
    axis_rad = axes_rad(positions_m[bearing])
    return EstimationPlan(
        info=info,
        calibration=calibration,
        tare=tare,
        models=tuple(name for name in MODELS if name in models),
        lag_ns=round(lag_ms * 1e6),
        compensation=Compensation(info.tiles),
        ladder=ladder,
        bearing=bearing,
        references=np.flatnonzero([tile.reference for tile in info.tiles]),
        baseline_kpa=baseline_kpa,
        baseline_sigma_kpa=tare.baseline_sigma_kpa[bearing],
        noise_kpa=tare.noise_kpa[bearing],
        noise_left=_noise_left(tare, bearing, info.nominal_rate_hz),
        late_ns=np.array(
            [
                round(1e9 * late.value) if (late := e.effects.late_s) is not None else 0
                for e in entries
            ],
            dtype=np.int64,
        ),
        late_sigma_s=np.array(
            [late.sigma if (late := e.effects.late_s) is not None else 0.0 for e in entries]
        ),
        late_common_s=np.array([e.effects.late_common_s for e in entries]),
        chip_end_kpa=chip_end_kpa,
        unseen=make_unseen(ladder.curves, ladder.gas, baseline_kpa, chip_end_kpa),
        watch=make_watch(
            info,
            calibration,
            tare,
            chip_end_kpa,
            gas_known=ladder.gas_known & (ladder.gas is not None),
            warms=ladder.temperature is None,
        ),
        still_kpa=still_kpa,
        bearing_m=positions_m[bearing],
        cop_measured=(info.row_place_m[0] is None, info.row_place_m[1] is None),
        gain=np.array([1.0 if gain is None else gain.value for gain in gains]),
        gain_sigma=np.array([0.0 if gain is None else gain.sigma for gain in gains]),
        axis_rad=axis_rad,
        tilted=lost_by_tilt(axis_rad),
        shear=None if calibration.mounted is None else calibration.mounted.shear,
        hull=hull(positions_m[bearing, :2]),
        grid=grid_indices(positions_m[bearing, :2]),
        contact=ContactRule(
            on_n=CONTACT_ON_SIGMA * unloaded_n,
            off_n=CONTACT_OFF_SIGMA * unloaded_n,
            min_ns=CONTACT_MIN_NS,
        ),
        assumed_scale=any(
            entry.absolute_scale == "assumed" and gain is None
            for entry, gain in zip(entries, gains, strict=True)
        ),
        gap_ns=round(GAP * 1e9 / info.nominal_rate_hz),
    )


def _noise_left(tare: Tare, bearing: npt.NDArray[np.intp], rate_hz: float) -> Floats:
    readings = np.arange(denoise.AVERAGED_MAX + 1)
    if tare.noise_lasting is None or tare.noise_lasting_s is None:
        return np.ones((len(bearing), len(readings)))
    part, lasts_s = tare.noise_lasting[bearing, None], tare.noise_lasting_s[bearing, None]
    return left_by_mean(part, lasts_s * rate_hz, np.maximum(readings, 1))


def _chip_end_kpa(entry: TileCalibration, baseline_kpa: float) -> float:
    facts = entry.bench
    if facts is None:
        return max(PRESSURE_MAX_KPA, baseline_kpa + entry.range_kpa[1])
    if facts.ended_by == "chip":
        return facts.end_absolute_kpa
    return max(PRESSURE_MAX_KPA, facts.end_absolute_kpa)


def warm_up_s(plan: EstimationPlan) -> float:
    """How long models have to run before what they give can be used."""
    ladder, longest_s = plan.ladder, 0.0
    if ladder.gas is not None:
        longest_s = max(longest_s, float((ladder.gas.gamma * ladder.gas.tau_s).max()))
    if ladder.rubber is not None:
        longest_s = max(longest_s, float(ladder.rubber.tau_s[ladder.rubber.part > 0.0].max()))
    if ladder.temperature is not None:
        longest_s = max(longest_s, float(np.abs(ladder.temperature.lag_s).max()))
    return max(WARM_UP_LEAST_S, WARM_UP_TIMES * longest_s)
