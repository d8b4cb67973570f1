"""Sample stage: raw pressures to the apparent force on every dome, reading by reading.

Apparent force: by the static curve, before hysteresis and creep of the rubber are removed. Order of
the models: unwrap, outliers, temperature, ambient, gas, static, and skew without denoise.

Counts of an MPL115A2 wrap beyond some 25 N (hardware.md 1.3), and at face value full load reads as
about 23 kPa. Recognised without memory: no sealed bubble can be below 50 kPa, the begin of the
chip's range, so a lower reading is a count that wrapped once. A bus that reads all ones is no such
case: the driver flags it, and it never becomes a pressure.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from devices.arrays import Times
from devices.chips import pressure_chip
from devices.flags import EstimateFlag, TileFlag
from devices.frames import HOLD_MAX_NS, NOT_READ
from devices.jit import jit_cached, jit_inlined
from service.estimation.fault_detection.baseline_loss import (
    ERROR_MIN_KPA,
    update_baseline_error_bound_kpa,
    update_thermal_drift_kpa,
)
from service.estimation.fault_detection.clipping import update_clipping_limit_kpa
from service.estimation.fault_detection.stuck import update_stuck_and_load_changes
from service.estimation.foot import store_servo_reading_and_link_to_previous
from service.estimation.models import gas
from service.estimation.models.ambient import low_pass_ambient_kpa
from service.estimation.models.denoise import WINDOW_READINGS_MAX, is_outlier
from service.estimation.models.skew import interpolate_to_frame
from service.estimation.models.static import compute_capped_force_slope_and_fit_sigma
from service.estimation.models.temperature import refer_to_tare_temperature_with_sigma
from service.estimation.pipeline.params import FootParams, KernelParams, TileParams
from service.estimation.pipeline.plan import SUCTION_MAX_KPA, TARE_OLD_NS
from service.estimation.pipeline.saturation import (
    UNIFORM_SIGMA,
    extrapolate_capped_force_n,
    is_after_long_gap,
    select_farther_bound,
)
from service.estimation.pipeline.state import (
    FootState,
    FrameBuffer,
    FrameRow,
    TileSample,
    TileState,
)
from service.estimation.records import RecordArray

_SATURATED = int(EstimateFlag.SATURATED)
_EXTRAPOLATED = int(EstimateFlag.EXTRAPOLATED)
_OUTLIER_REPLACED = int(EstimateFlag.OUTLIER_REPLACED)
_GAP = int(EstimateFlag.GAP)
_TILE_MISSING = int(EstimateFlag.TILE_MISSING)
_ASSUMED_SCALE = int(EstimateFlag.ASSUMED_SCALE)
_TARE_OLD = int(EstimateFlag.TARE_OLD)
_OVER_RATED = int(EstimateFlag.OVER_RATED)
_TARE_LOST = int(EstimateFlag.TARE_LOST)
_STUCK = int(EstimateFlag.STUCK)
_CLIPPED = int(EstimateFlag.CLIPPED)
_BASELINE_LOST = int(EstimateFlag.BASELINE_LOST)


@jit_inlined
def compute_apparent_forces(
    params: KernelParams,
    foot_state: FootState,
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    i: int,
) -> None:
    """Compute apparent forces and flags of row `i`, in the buffer.

    Args:
        params: of the estimate.
        foot_state: updated.
        tile_states: (tiles,), updated.
        buffer: with this row and, if frames wait for it, the next.
        i: row, the first that this stage has not processed.
    """
    foot_params, row, n = params.foot[0], buffer.rows[i], len(tile_states)
    t_ns = buffer.t_mono_ns[i]
    row.flags = _frame_flags(foot_params, row)
    after = buffer.rows[i + 1] if i + 1 < foot_state.end_row else row
    has_after = i + 1 < foot_state.end_row and after.after_gap == 0
    ambient_kpa, bare_sum_kpa, bare_count = 0.0, 0.0, 0
    foot_kpa = 0.0
    for j in range(n):
        if params.tiles[j].is_load_bearing == 1:
            foot_kpa += buffer.samples[i, j].pressure_kpa - params.tiles[j].baseline_kpa
    for j in range(n):
        tile_params, sample = params.tiles[j], buffer.samples[i, j]
        if foot_params.is_tare_lost == 0 and _has_temperature_changed(tile_params, sample):
            row.flags |= _TARE_OLD
        after_kpa = buffer.samples[i + 1, j].pressure_kpa if has_after else math.nan
        _detect_faults(
            foot_params, tile_params, foot_state, tile_states[j], row, sample, after_kpa, foot_kpa,
            n,
        )  # fmt: skip
        gauge_kpa = sample.pressure_kpa - tile_params.baseline_kpa
        # A bare tile beyond the chip's range shows a fault of its own, not the surroundings.
        is_bare = tile_params.is_load_bearing == 0
        if is_bare and sample.is_over_range == 0 and math.isfinite(gauge_kpa):
            bare_sum_kpa += gauge_kpa
            bare_count += 1
    if foot_params.has_ambient == 1:
        mean_kpa = bare_sum_kpa / bare_count if bare_count > 0 else math.nan
        ambient_kpa = low_pass_ambient_kpa(foot_state.ambient, mean_kpa, t_ns)
    total_n = known_n = noise_n2 = usable_n = 0.0
    offset_sum_ns = 0
    for j in range(n):
        tile_params, sample = params.tiles[j], buffer.samples[i, j]
        if tile_params.is_load_bearing == 0:
            sample.gauge_kpa = sample.pressure_kpa - tile_params.baseline_kpa
            continue
        at_ns = buffer.sampled_ns[i, j]
        slope = _compute_apparent_force(
            foot_params, tile_params, tile_states[j], row, sample, at_ns, t_ns, ambient_kpa
        )
        noise_n = abs(slope) * tile_params.noise_kpa
        # A lower bound must not be averaged with forces that are none.
        usable = math.nan if sample.is_saturated == 1 else sample.apparent_n
        buffer.noise_n[i, j], buffer.usable_n[i, j] = noise_n, usable
        total_n += sample.apparent_n
        known_n += 0.0 if math.isnan(sample.apparent_n) else sample.apparent_n
        usable_n += usable
        noise_n2 += noise_n**2
        # Of offsets: the sum of instants may overflow.
        offset_sum_ns += at_ns - t_ns
    # The known tiles may prove contact by themselves.
    row.is_contact_bound = 1 if math.isnan(total_n) else 0
    buffer.contact_n[i] = known_n if row.is_contact_bound == 1 else total_n
    buffer.usable_n[i, n], buffer.noise_n[i, n] = usable_n, math.sqrt(noise_n2)
    buffer.sampled_ns[i, n] = t_ns + offset_sum_ns // foot_params.n_load_bearing


@jit_cached
def _frame_flags(foot_params: FootParams, row: FrameRow) -> int:
    flags = _GAP if row.after_gap == 1 else 0
    if foot_params.is_scale_assumed == 1:
        flags |= _ASSUMED_SCALE
    if foot_params.is_tare_lost == 1:
        return flags | _TARE_LOST
    return flags | _TARE_OLD if row.t_ns - foot_params.tare_ns > TARE_OLD_NS else flags


@jit_cached
def _has_temperature_changed(tile_params: TileParams, sample: TileSample) -> bool:
    """Return whether the temperature since the tare has changed by more than a baseline allows.

    With a model for the temperature it may.
    """
    moved_counts = abs(sample.temperature_raw - tile_params.tare_counts)
    is_checked = tile_params.is_load_bearing == 1 and tile_params.temperature.is_used == 0
    return (
        is_checked
        and moved_counts > tile_params.temperature_change_max_counts
        and not math.isnan(sample.pressure_kpa)
    )


@jit_cached
def _detect_faults(
    foot_params: FootParams,
    tile_params: TileParams,
    foot_state: FootState,
    tile_state: TileState,
    row: FrameRow,
    sample: TileSample,
    after_kpa: float,
    foot_kpa: float,
    tiles: int,
) -> None:
    """Detect clipping, a stuck tile and outliers, and remove their pressures."""
    as_read_kpa = sample.pressure_kpa
    baseline_kpa, noise_kpa = tile_params.baseline_kpa, tile_params.noise_kpa
    if foot_params.has_fault_detection == 1:
        unloaded_band_kpa = tile_params.faults.unloaded_band_kpa
        if tile_params.is_load_bearing == 1:
            update_clipping_limit_kpa(
                tile_state.clipping, as_read_kpa, row.t_ns, baseline_kpa, unloaded_band_kpa,
                noise_kpa, tile_params.variance_inflation[WINDOW_READINGS_MAX],
                foot_kpa - (as_read_kpa - baseline_kpa),
            )  # fmt: skip
        may_stand_still = as_read_kpa >= tile_params.faults.stuck_check_max_kpa
        above_kpa = math.nan if may_stand_still else as_read_kpa - baseline_kpa
        stuck, foot_state.load_changes = update_stuck_and_load_changes(
            foot_params.equal_count_limits, tile_params.faults.stuck, tile_state.stuck,
            sample.pressure_raw, above_kpa, unloaded_band_kpa, foot_state.load_changes, tiles,
        )  # fmt: skip
        if stuck:
            row.flags |= _STUCK
            sample.pressure_kpa = math.nan
    if foot_params.waits_for_next == 1:
        before_kpa = math.nan if row.after_gap == 1 else tile_state.previous_kpa
        tile_state.previous_kpa = as_read_kpa
        if is_outlier(before_kpa, sample.pressure_kpa, after_kpa, noise_kpa):
            sample.pressure_kpa = 0.5 * (before_kpa + after_kpa)
            if tile_params.is_load_bearing == 1:
                row.flags |= _OUTLIER_REPLACED


@jit_cached
def _compute_apparent_force(
    foot_params: FootParams,
    tile_params: TileParams,
    tile_state: TileState,
    row: FrameRow,
    sample: TileSample,
    t_ns: int,
    frame_t_ns: int,
    ambient_kpa: float,
) -> float:
    """Compute the apparent force on a load-bearing tile; return its curve's slope in N/kPa."""
    flags = 0
    kpa, variance = sample.pressure_kpa, tile_params.baseline_variance
    if tile_params.temperature.is_used == 1:
        is_read = sample.temperature_raw != NOT_READ
        counts = float(sample.temperature_raw) if is_read else math.nan
        kpa, sigma_kpa = refer_to_tare_temperature_with_sigma(
            tile_params.temperature, tile_state.temperature, kpa, counts, t_ns
        )
        variance += sigma_kpa**2
    if foot_params.has_ambient == 1:
        transmitted_kpa = ambient_kpa * tile_params.ambient.transmitted_fraction
        kpa -= transmitted_kpa
        variance += (tile_params.ambient.relative_sigma * transmitted_kpa) ** 2
    sample.gauge_kpa = kpa - tile_params.baseline_kpa
    if sample.gauge_kpa < -SUCTION_MAX_KPA:  # a torn dome, or another fault
        kpa = math.nan
    # The pressure as read tells the chip's range, the pressure after cooling the calibrated one.
    end_kpa = tile_params.chip_max_kpa
    if tile_state.clipping.end_kpa < math.inf:
        end_kpa = min(end_kpa, tile_state.clipping.end_kpa)
        flags |= _CLIPPED if sample.pressure_kpa > tile_state.clipping.end_kpa else 0
    is_hidden = sample.pressure_kpa > end_kpa
    # As if the chip's end had been read, less the shares of warmth and surroundings.
    least_kpa = kpa - (sample.pressure_kpa - end_kpa if is_hidden else 0.0)
    cooled_kpa, gas_kpa, gas_alt_kpa = kpa, 0.0, 0.0
    if tile_params.gas.is_used == 1:
        found_kpa, gas_alt_kpa = _isothermal_pressure(
            tile_params, tile_state, kpa, least_kpa, t_ns, is_hidden
        )
        gas_kpa = found_kpa - kpa
        # A tile whose rig recording does not determine its gas has no correction, but this sigma.
        cooled_kpa = found_kpa if tile_params.gas.is_known == 1 else kpa
        least_kpa = gas.compute_isothermal_lower_bound_kpa(tile_params.gas, least_kpa)
    static_kpa = (least_kpa if is_hidden else cooled_kpa) - tile_params.baseline_kpa
    drift_kpa = baseline_error_kpa = 0.0
    if foot_params.has_fault_detection == 1:
        if foot_params.has_thermal_drift == 1:
            drift_kpa = update_thermal_drift_kpa(
                tile_state.thermal_drift, sample.temperature_raw, tile_params.tare_counts,
                tile_params.faults.thermal_kpa_per_count, t_ns,
            )  # fmt: skip
        seen_kpa = math.nan if is_hidden else static_kpa
        baseline_error_kpa = update_baseline_error_bound_kpa(
            tile_state.baseline_loss, tile_params.faults.asymmetry, seen_kpa, variance, drift_kpa,
            t_ns,
        )  # fmt: skip
        if baseline_error_kpa > 0.0 or abs(drift_kpa) > ERROR_MIN_KPA:
            flags |= _BASELINE_LOST
    variance += baseline_error_kpa**2
    force_n, slope, fit_sigma_n = compute_capped_force_slope_and_fit_sigma(
        tile_params.static, static_kpa
    )
    if math.isnan(sample.pressure_kpa if foot_params.is_tare_lost == 1 else force_n):
        flags |= _TILE_MISSING
    is_saturated = is_hidden or static_kpa > tile_params.static.range_high_kpa
    sample.extrapolated_n = math.nan
    if is_saturated:
        flags |= _SATURATED
        gauge_kpa = cooled_kpa - tile_params.baseline_kpa
        curve_n, _, _ = compute_capped_force_slope_and_fit_sigma(tile_params.static, gauge_kpa)
        sample.extrapolated_n = extrapolate_capped_force_n(
            tile_params.saturation, curve_n, gauge_kpa
        )
    elif sample.pressure_kpa > tile_params.rated_max_kpa:
        flags |= _OVER_RATED
    if static_kpa < tile_params.range_low_kpa:
        flags |= _EXTRAPOLATED
    if tile_params.skew.is_used == 1 and foot_params.has_denoise == 0:
        force_n = interpolate_to_frame(
            tile_state.skew, force_n, t_ns, frame_t_ns, row.after_gap == 1
        )
    row.flags |= flags
    sample.apparent_n, sample.is_saturated = force_n, 1 if is_saturated else 0
    sample.systematic_sigma_n = math.sqrt(slope**2 * variance + fit_sigma_n**2)
    sample.gas_error_n = slope * tile_params.gas.misfit * gas_kpa
    sample.gas_alt_error_n, sample.thermal_error_n = slope * gas_alt_kpa, slope * drift_kpa
    return slope


@jit_cached
def _isothermal_pressure(
    tile_params: TileParams,
    tile_state: TileState,
    kpa: float,
    least_kpa: float,
    t_ns: int,
    is_hidden: bool,
) -> tuple[float, float]:
    """Return the pressure after cooling, and its sigma by saturation and gaps before.

    A pressure beyond the chip's end is used as read: the best guess, and no more than a guess.
    """
    most_kpa = tile_params.saturation.force_max_hot_kpa
    used_kpa = min(kpa, most_kpa) if is_hidden and not math.isnan(kpa) else kpa
    is_known = 0.0 < used_kpa < math.inf and not math.isnan(tile_state.gas.ln_kpa)
    had_gap = is_known and is_after_long_gap(t_ns, tile_state.gas.t_ns)
    # The first reading, under load: when that came is not known.
    is_first = 0.0 < used_kpa < math.inf and math.isnan(tile_state.gas.ln_kpa)
    begins_loaded = is_first and kpa - tile_params.baseline_kpa > tile_params.unloaded_max_kpa
    if tile_state.has_gas_alt == 0 and not is_hidden and not had_gap and not begins_loaded:
        return gas.compute_isothermal_pressure(
            tile_params.gas, tile_state.gas, used_kpa, t_ns, math.nan
        ), 0.0
    if tile_state.has_gas_alt == 0:
        gas.copy_state(tile_state.gas, tile_state.gas_alt)
        if begins_loaded:
            gas.begin_after_gap(tile_state.gas_alt, t_ns)
    found = gas.compute_isothermal_pressure(
        tile_params.gas, tile_state.gas, used_kpa, t_ns, math.nan
    )
    alt_kpa = select_farther_bound(used_kpa, least_kpa, most_kpa) if is_hidden else kpa
    gap_kpa = tile_params.saturation.range_end_hot_kpa
    other = gas.compute_isothermal_pressure(
        tile_params.gas, tile_state.gas_alt, alt_kpa, t_ns, gap_kpa
    )
    tile_state.has_gas_alt = 0 if gas.is_same_state(tile_state.gas, tile_state.gas_alt) else 1
    return found, 0.0 if is_hidden else UNIFORM_SIGMA * (other - found)


@jit_cached
def unwrap_pressure(
    kpa: float, kpa_per_count: float, rated_min_kpa: float, wrap_counts: float
) -> float:
    """Return the absolute pressure with a wrapped count corrected to below zero.

    Args:
        kpa: compensated pressure.
        kpa_per_count: pressure step of one raw pressure count (negative).
        rated_min_kpa: begin of the chip's range.
        wrap_counts: counts after which they wrap; 0: never.

    Returns:
        Pressure in kPa; beyond every calibrated range if the count had wrapped.
    """
    return kpa - wrap_counts * kpa_per_count if kpa < rated_min_kpa else kpa


_UNUSABLE = int(TileFlag.UNUSABLE)
_OVER_RANGE = int(TileFlag.OVER_RANGE)
_kpa_of = jit_cached(pressure_chip.compute_kpa)
_kpa_per_count_of = jit_cached(pressure_chip.compute_kpa_per_count)


@jit_inlined
def append_frames_to_buffer(
    params: KernelParams,
    foot_state: FootState,
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    seq: npt.NDArray[np.uint64],
    t_mono_ns: Times,
    t_ns: Times,
    pressure_raw: npt.NDArray[np.uint16],
    temperature_raw: npt.NDArray[np.uint16],
    sample_offset_us: npt.NDArray[np.int32],
    servo_counts: npt.NDArray[np.int32],
    servo_age_us: npt.NDArray[np.int32],
    tile_flags: npt.NDArray[np.uint8],
    frame_flags: npt.NDArray[np.uint8],
) -> None:
    """Convert n frames to pressures and append them to the buffer; columns as in `FrameBatch`.

    Counts are as words of 16 bits, one or two a tile: one compilation does for any chip.
    """
    foot_params = params.foot[0]
    words = pressure_raw.shape[1] // len(tile_states)
    for k in range(len(seq)):
        i = foot_state.end_row
        row, now_ns = buffer.rows[i], t_mono_ns[k]
        row.seq, row.t_ns, buffer.t_mono_ns[i] = seq[k], t_ns[k], now_ns
        gap = pause = False
        if i > 0:  # a row of the frames before always remains
            passed_ns = now_ns - buffer.t_mono_ns[i - 1]
            # Unsigned throughout: a difference wraps, and any number is compared as it is.
            follows = np.uint64(seq[k] - buffer.rows[i - 1].seq) == np.uint64(1)
            gap = not follows or passed_ns > foot_params.gap_ns
            pause = passed_ns > foot_params.contact_pause_ns
        row.after_gap, row.after_contact_pause = 1 if gap else 0, 1 if pause else 0
        foot_state.run_count += row.after_gap
        buffer.run[i] = foot_state.run_count
        if foot_params.has_servo == 1:
            store_servo_reading_and_link_to_previous(
                buffer.readings, i, now_ns, int(servo_counts[k]), int(servo_age_us[k]),
                frame_flags[k], foot_params.counts_per_turn, gap,
            )  # fmt: skip
        for j in range(len(tile_states)):
            tile_params, tile_state = params.tiles[j], tile_states[j]
            sample = buffer.samples[i, j]
            flags = np.int64(tile_flags[k, j])
            sample.is_over_range = 1 if flags & _OVER_RANGE != 0 else 0
            at = j * words  # a function for this would cost a tenth of the step
            sample.pressure_raw, sample.temperature_raw = (
                pressure_raw[k, at],
                temperature_raw[k, at],
            )
            if words == 2:  # the lower one first
                sample.pressure_raw += int(np.int64(pressure_raw[k, at + 1]) << 16)
                sample.temperature_raw += int(np.int64(temperature_raw[k, at + 1]) << 16)
            if sample.temperature_raw == NOT_READ:  # a chip's temperature holds for a second
                if now_ns - tile_state.temperature_ns <= HOLD_MAX_NS:
                    sample.temperature_raw = tile_state.temperature_raw
            elif flags & _UNUSABLE == 0:
                tile_state.temperature_raw = sample.temperature_raw
                tile_state.temperature_ns = now_ns
            offset_ns = 1000 * np.int64(sample_offset_us[k, j])
            buffer.sampled_ns[i, j] = now_ns + offset_ns + tile_params.sample_delay_ns
            sample.pressure_kpa = math.nan
            is_read = sample.pressure_raw != NOT_READ and sample.temperature_raw != NOT_READ
            if flags & _UNUSABLE == 0 and is_read:
                p, t = float(sample.pressure_raw), float(sample.temperature_raw)
                chip = tile_params
                kpa = _kpa_of(
                    p, t, chip.a0, chip.b1, chip.b2, chip.c12, chip.unit_kpa, chip.offset_kpa
                )
                if tile_params.unwrap.is_used == 1:
                    count_kpa = _kpa_per_count_of(t, chip.b1, chip.c12, chip.unit_kpa)
                    kpa = unwrap_pressure(kpa, count_kpa, chip.rated_min_kpa, chip.wrap_counts)
                if kpa >= chip.rated_min_kpa:
                    sample.pressure_kpa = kpa
        foot_state.newest_ns = now_ns
        foot_state.end_row += 1
