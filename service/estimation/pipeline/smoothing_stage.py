"""Smoothing stage: apparent forces to forces on every dome, within the look-ahead.

Order of the models: denoise, flow, hysteresis, rubber. Loop and creep are removed in the opposite
order in which the dome makes them, and after the noise, because both have a state. Sums over tiles
add them one after the other.
"""

from __future__ import annotations

import math
from typing import Annotated

from devices.arrays import Floats
from devices.flags import EstimateFlag
from devices.jit import jit_cached, jit_inlined
from service.estimation.models import denoise, flow, hysteresis, rubber
from service.estimation.pipeline.params import KernelParams, TileParams
from service.estimation.pipeline.saturation import (
    UNIFORM_SIGMA,
    is_after_long_gap,
    select_farther_bound,
)
from service.estimation.pipeline.state import DomeState, FrameBuffer, TileSample, TileState
from service.estimation.records import KernelRecord, RecordArray

_AFTER_SATURATION = int(EstimateFlag.AFTER_SATURATION)
_HISTORY_UNKNOWN = int(EstimateFlag.HISTORY_UNKNOWN)

BOUND_SIGMAS = 2.33
"""Distance of a stated bound in standard uncertainties: one in a hundred is above the truth."""
N_COMMON = 8
"""Number of errors that all tiles share: remaining errors of gas and rubber corrections, state of
gas and of rubber after saturation or gaps, smoothing of the load, thermal drift, delay of the rig's
reference, and direction of the ground's force (along the tiles' axes or along the segment)."""


class TileForce(KernelRecord):
    """Force on a tile in one frame."""

    # While saturated: least force if nothing is uncertain. NaN where unknown, or without load.
    force_n: float
    dome_n: float  # force on the dome: without the gain of its mount
    correction_n: float  # of loop and creep: `dome_n` less the averaged apparent force
    sigma_n: float  # standard uncertainty of the force
    sigma_independent_n: float  # its part that is independent between tiles
    sigma_common_n: Annotated[Floats, (N_COMMON,)]  # signed errors that all tiles share
    is_saturated: int  # 1: the force is a lower bound
    noise_n: float  # noise after averaging
    window_difference_n: float  # average less that of a window of half the length
    window_difference_sigma_n: float  # standard deviation of that by noise
    smoothing_error_n: float  # load removed by averaging, as far as the sum of tiles shows
    vertical_fraction: float  # part of the force that is vertical
    weight: float  # in a sum over tiles


TILE_FORCE = TileForce.dtype()


@jit_inlined
def compute_forces_and_flags(
    params: KernelParams,
    tile_states: RecordArray[TileState],
    buffer: FrameBuffer,
    i: int,
    rows: tuple[int, int],
    windows: Floats,
    forces: RecordArray[TileForce],
) -> int:
    """Compute the tiles' forces in row `i`, into `forces`; return flags of loads not seen.

    Args:
        params: of the estimate.
        tile_states: (tiles,), updated.
        buffer: with all rows that windows reach.
        i: row.
        rows: oldest and newest that windows may reach.
        windows: scratch of `denoise`.
        forces: (tiles,), the answer.

    Returns:
        Bits of `EstimateFlag`: loads during saturation or gaps, or before the first frame, leave
        more uncertainty than the noise of a reading, in any tile.
    """
    foot_params, n = params.foot[0], len(tile_states)
    for j in range(n):
        force = forces[j]
        is_load_bearing = params.tiles[j].is_load_bearing == 1
        force.force_n = buffer.samples[i, j].apparent_n if is_load_bearing else math.nan
        force.noise_n, force.smoothing_error_n = buffer.noise_n[i, j], 0.0
    if foot_params.has_denoise == 1:
        denoise_forces_and_scale_noise(params, buffer, i, rows, windows, forces)
    flags = 0
    for j in range(n):
        tile_params, sample = params.tiles[j], buffer.samples[i, j]
        if tile_params.is_load_bearing == 1:
            at_ns = (
                buffer.t_mono_ns[i]
                if foot_params.is_at_frame_instant == 1
                else buffer.sampled_ns[i, j]
            )
            alt_n = _correct_force(tile_params, tile_states[j], sample, forces[j], at_ns)
            if sample.is_saturated == 0 and alt_n > buffer.noise_n[i, j]:
                is_first = tile_states[j].is_history_unknown == 1
                flags |= _HISTORY_UNKNOWN if is_first else _AFTER_SATURATION
    return flags


@jit_cached
def _correct_force(
    tile_params: TileParams,
    tile_state: TileState,
    sample: TileSample,
    force: TileForce,
    at_ns: int,
) -> float:
    """Correct a tile's averaged force in place; return its sigma by saturation and gaps, in N."""
    averaged_n, dome_alt_n = force.force_n, 0.0
    force_n = averaged_n
    if tile_params.hysteresis.is_used == 1 or tile_params.rubber.is_used == 1:
        force_n, dome_alt_n = _remove_hysteresis_and_creep(
            tile_params, tile_state, sample, averaged_n, at_ns
        )
    rate = _update_rise_rate(tile_state, force_n, at_ns)
    independent_n = math.sqrt(
        force.noise_n**2
        + sample.systematic_sigma_n**2
        + (rate * tile_params.sample_delay_sigma_s) ** 2
    )
    common_n = force.sigma_common_n
    common_n[0] = sample.gas_error_n
    force.dome_n, force.correction_n = force_n, force_n - averaged_n
    common_n[1] = tile_params.dome_misfit * force.correction_n
    common_n[2], common_n[3] = sample.gas_alt_error_n, dome_alt_n
    common_n[4], common_n[5] = force.smoothing_error_n, sample.thermal_error_n
    common_n[6] = rate * tile_params.sample_delay_common_sigma_s
    common_n[7] = tile_params.tilt_loss * force_n
    variance = independent_n**2
    for part in range(N_COMMON - 1):
        variance += common_n[part] ** 2
    force.force_n, force.sigma_independent_n = force_n, independent_n
    force.sigma_n, force.is_saturated = math.sqrt(variance), sample.is_saturated
    _apply_mount_gain(tile_params, force)
    return math.sqrt(sample.gas_alt_error_n**2 + dome_alt_n**2)


@jit_cached
def _apply_mount_gain(tile_params: TileParams, force: TileForce) -> None:
    """Convert newtons of the dome to newtons of the ground on the tile's part of the foot."""
    gain, gain_sigma = tile_params.mount_gain, tile_params.mount_gain_sigma
    if gain == 1.0 and gain_sigma == 0.0:
        return
    of_gain_n = gain_sigma * force.force_n
    force.force_n *= gain
    force.sigma_independent_n = math.hypot(gain * force.sigma_independent_n, of_gain_n)
    force.sigma_n = math.hypot(gain * force.sigma_n, of_gain_n)
    for part in range(N_COMMON):
        force.sigma_common_n[part] *= gain


@jit_inlined
def denoise_forces_and_scale_noise(
    params: KernelParams,
    buffer: FrameBuffer,
    i: int,
    rows: tuple[int, int],
    windows: Floats,
    forces: RecordArray[TileForce],
) -> None:
    """Replace the forces of row `i` by denoised ones.

    Windows of the sum of all tiles bound those of each. Tiles bear the same load: its changes
    exceed the noise of their sum before they exceed the noise of any one, and a little smoothing in
    each tile would add up in the GRF.
    """
    foot_params, n, within = params.foot[0], len(params.tiles), denoise.ALL_ROWS
    columns = buffer.usable_n, buffer.noise_n, buffer.sampled_ns, buffer.run
    at_frame, frame_ns = foot_params.is_at_frame_instant == 1, buffer.t_mono_ns[i]
    if foot_params.n_load_bearing > 1 and not math.isnan(buffer.usable_n[i, n]):
        at_ns = frame_ns if at_frame else buffer.sampled_ns[i, n]
        _, within = denoise.denoise_sample(
            columns, i, n, at_ns, rows, foot_params.variance_inflation, within, windows
        )
    for j in range(n):
        force, tile_params = forces[j], params.tiles[j]
        force.window_difference_n = math.nan
        if tile_params.is_load_bearing == 0 or math.isnan(buffer.usable_n[i, j]):
            continue
        at_ns = frame_ns if at_frame else buffer.sampled_ns[i, j]
        inflation = tile_params.variance_inflation
        (force.force_n, variance, force.window_difference_n, difference_variance), _ = (
            denoise.denoise_sample(columns, i, j, at_ns, rows, inflation, within, windows)
        )
        force.window_difference_sigma_n = force.noise_n * math.sqrt(difference_variance)
        force.noise_n *= math.sqrt(variance)
    denoise.estimate_smoothing_errors(forces)


@jit_cached
def _remove_hysteresis_and_creep(
    tile_params: TileParams,
    tile_state: TileState,
    sample: TileSample,
    force_n: float,
    at_ns: int,
) -> tuple[float, float]:
    """Return the force without loop and creep, and its sigma by saturation and gaps before."""
    is_saturated, had_gap = sample.is_saturated == 1, False
    if tile_state.has_force == 0 and not math.isnan(force_n):
        tile_state.has_force = 1
        _begin_under_load(tile_params, tile_state, force_n, at_ns)
    if tile_params.rubber.is_used == 1:
        last = tile_state.dome.rubber
        had_gap = not math.isnan(last.force_n) and is_after_long_gap(at_ns, last.t_ns)
    elif tile_params.hysteresis.has_flow == 1:
        last_of_flow = tile_state.dome.hysteresis.flow
        had_gap = not math.isnan(last_of_flow.force_n) and is_after_long_gap(
            at_ns, last_of_flow.t_ns
        )
    had_gap = had_gap and not math.isnan(force_n)
    if is_saturated or had_gap:
        tile_state.is_history_unknown = 0  # from here on the newer cause is the greater one
    state_force_n = sample.extrapolated_n if is_saturated else math.nan
    if tile_state.has_dome_alt == 0 and not is_saturated and not had_gap:
        found_n = _invert_dome_models(
            tile_params, tile_state.dome, force_n, at_ns, state_force_n, math.nan
        )
        return found_n, 0.0
    if tile_state.has_dome_alt == 0:
        _copy_dome_state(tile_state.dome, tile_state.dome_alt)
    found_n = _invert_dome_models(
        tile_params, tile_state.dome, force_n, at_ns, state_force_n, math.nan
    )
    bounds = tile_params.saturation
    if is_saturated:
        state_force_n = select_farther_bound(
            sample.extrapolated_n, sample.apparent_n, bounds.force_max_n
        )
    alt_n = _invert_dome_models(
        tile_params, tile_state.dome_alt, force_n, at_ns, state_force_n,
        bounds.range_end_n,
    )  # fmt: skip
    is_same = _is_same_dome_state(tile_params, tile_state.dome, tile_state.dome_alt)
    tile_state.has_dome_alt = 0 if is_same else 1
    if is_saturated:
        return alt_n if alt_n < found_n else found_n, 0.0
    return found_n, UNIFORM_SIGMA * (alt_n - found_n)


@jit_cached
def _begin_under_load(
    tile_params: TileParams, tile_state: TileState, force_n: float, at_ns: int
) -> None:
    """Set both states of a tile whose first force is a load: earlier ones are not known.

    Best guess: this load for long, since a foot stands longer than it takes to put it down.
    Alternative: the farther of no load, and the largest load that leaves this force, each for long
    and until just now. Creep presses on after a load, so a smaller force bounds that load. Without
    a load the dome is at rest, which is the initial state.
    """
    unloaded_max_n = tile_params.unloaded_max_kpa * tile_params.static.slope_at_zero_n_per_kpa
    if not force_n > unloaded_max_n:
        return
    most_n = tile_params.saturation.range_end_n
    if tile_params.rubber.is_used == 1:
        later = rubber.sum_fractions(tile_params.rubber)
        most_n = force_n / later if force_n < most_n * later else most_n
    past_n = select_farther_bound(force_n, 0.0, most_n)
    _settle_dome(tile_params, tile_state.dome, force_n, 0.0, at_ns)
    _settle_dome(tile_params, tile_state.dome_alt, past_n, past_n, at_ns)
    tile_state.has_dome_alt = tile_state.is_history_unknown = 1


@jit_cached
def _settle_dome(
    tile_params: TileParams, dome_state: DomeState, force_n: float, highest_n: float, at_ns: int
) -> None:
    hysteresis.settle_state(
        tile_params.hysteresis, dome_state.hysteresis, force_n, highest_n, at_ns
    )
    rubber.settle_state(tile_params.rubber, dome_state.rubber, force_n, at_ns)


@jit_cached
def _invert_dome_models(
    tile_params: TileParams,
    dome_state: DomeState,
    force_n: float,
    at_ns: int,
    state_force_n: float,
    gap_force_n: float,
) -> float:
    loop, loop_state = tile_params.hysteresis, dome_state.hysteresis
    if loop.has_flow == 1:
        force_n = flow.compensate_flow(
            loop.flow, loop_state.flow, force_n, at_ns, state_force_n, gap_force_n
        )
    if loop.is_used == 1:
        force_n = hysteresis.compensate_hysteresis(loop, loop_state, force_n, state_force_n)
    if tile_params.rubber.is_used == 1:
        force_n = rubber.compensate_creep(
            tile_params.rubber, dome_state.rubber, force_n, at_ns, state_force_n, gap_force_n
        )
    return force_n


@jit_cached
def _copy_dome_state(dome_state: DomeState, to: DomeState) -> None:
    hysteresis.copy_state(dome_state.hysteresis, to.hysteresis)
    rubber.copy_state(dome_state.rubber, to.rubber)


@jit_cached
def _is_same_dome_state(tile_params: TileParams, one: DomeState, other: DomeState) -> bool:
    """Return whether two states are equal in the models that are used."""
    is_same = hysteresis.is_same_state(tile_params.hysteresis, one.hysteresis, other.hysteresis)
    if tile_params.rubber.is_used == 1:
        is_same = is_same and rubber.is_same_state(one.rubber, other.rubber)
    return is_same


@jit_cached
def _update_rise_rate(tile_state: TileState, force_n: float, at_ns: int) -> float:
    """Return the rise of the force since the frame before in N/s; 0 where unknown."""
    rise_n = force_n - tile_state.previous_force_n
    step_s = 1e-9 * (at_ns - tile_state.previous_force_ns)
    known = tile_state.has_previous_force == 1 and math.isfinite(rise_n) and step_s > 0.0
    tile_state.previous_force_n, tile_state.previous_force_ns = force_n, at_ns
    tile_state.has_previous_force = 1
    return rise_n / step_s if known else 0.0


@jit_inlined
def compute_weighted_sum_sigma(forces: RecordArray[TileForce]) -> float:
    """Return the sigma of a sum over tiles by `weight`.

    Independent parts add as squares, common ones with their sign. A tile of weight 0 may be
    unknown.
    """
    variance = 0.0
    shared = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # `N_COMMON`, in registers
    for j in range(len(forces)):
        weight, common_n = forces[j].weight, forces[j].sigma_common_n
        if weight != 0.0:
            variance += (weight * forces[j].sigma_independent_n) ** 2
            shared = (
                shared[0] + weight * common_n[0],
                shared[1] + weight * common_n[1],
                shared[2] + weight * common_n[2],
                shared[3] + weight * common_n[3],
                shared[4] + weight * common_n[4],
                shared[5] + weight * common_n[5],
                shared[6] + weight * common_n[6],
                shared[7] + weight * common_n[7],
            )
    for part in range(N_COMMON):
        variance += shared[part] * shared[part]
    return math.sqrt(variance)
