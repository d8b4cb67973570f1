"""Stuck tiles: the raw pressure stays the same for longer than its noise allows.

However a load moves, the chance that a reading equals the previous count is at most that of noise
centred on that count. The share of equal neighbours is learnt while a tile is unloaded, where
nothing else moves it; that includes correlated noise. So is the share of steps by two counts,
because a tile that wavers between two counts may yet be quiet in the middle of one. A light load
must not pass for noise, so the tare's noise counts as well. From these follows the number of equal
counts in a row that occurs once in `HOURS` by chance. A tile whose noise is far below a count may
repeat for ever: it is accepted, unless it stays at a load while the others are loaded and unloaded
again and again.

A repeated count is no measurement of this instant, so the force is unknown: NaN.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Annotated

import numpy as np

from devices.arrays import Floats, Ints
from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray

FALSE_ALARM_HOURS = 100.0
"""Mean time between false alarms of a healthy array with the learnt share of repeats."""
PRIOR_CORRELATION_S = 0.010
"""Correlation time of the noise that is assumed at first."""
PRIOR_PAIRS = 50
"""Weight of that assumption, in pairs of readings."""
NOISE_WITHOUT_OUTLIERS = 0.75
"""Part of the tare's noise without its outliers (hardware.md 1.3)."""
SHARE_MARGIN_SIGMAS = 2.0
"""Margin on the learnt shares, in standard deviations."""
SHARE_STEPS = 256
"""Number of steps of the share in the tables of limits."""
EQUAL_COUNT_MIN = 8
"""Largest number of equal counts in a row that is never judged."""
PAIRS_MAX = 1 << 14
"""Number of pairs after which the older ones count half."""
LOADINGS_OF_OTHERS = 5
"""Mean loadings of the other tiles after which a loaded tile without noise is stuck."""
UNLIMITED = 1 << 40
_STEP_MIN, _STEP_MAX = 0.02, 20.0


class StuckState(KernelRecord):
    """State of a tile."""

    pressure_raw: int = -1  # last count; -1 before the first
    equal_count: int  # number of equal counts in a row
    changes_at_start: int  # `load_changes` at the first of these
    was_unloaded: int  # 1: the last reading was
    unloaded_pairs: int  # consecutive unloaded readings
    equal_pairs: int  # of these
    double_step_pairs: int  # of these, two counts apart
    is_loaded: int


class StuckParams(KernelRecord):
    """Parameters of a tile: priors of its shares, and a limit of equal counts in a row."""

    equal_share: float  # of equal neighbours
    double_step_share: float  # of neighbours two counts apart
    equal_count_max: int  # limit for white noise as at the tare


class EqualCountLimits(KernelRecord):
    """Limits of equal counts in a row for an array, by the shares of a tile's neighbours."""

    max_by_equal_share: Annotated[Ints, (SHARE_STEPS + 1,)]
    max_by_double_step_share: Annotated[Ints, (SHARE_STEPS + 1,)]


def _compute_limit_tables(rate_hz: float, tiles: int) -> tuple[Ints, Ints]:
    """Compute tables of the limits of equal counts in a row, by the shares of steps 0 and 2.

    Neighbours whose difference has the standard deviation d, in counts, are equal or two counts
    apart with chances that are solved for d. Noise of d / sqrt(2) then repeats with erf(1 / 2d) at
    most.

    Returns:
        Limits by the share of equal neighbours in 0 to `SHARE_STEPS`, and by that of double steps.
    """
    chance = 1.0 / (FALSE_ALARM_HOURS * 3600.0 * rate_hz * tiles)
    most = []
    for at_most in _compute_repeat_chances():
        count = 1.0 + np.ceil(math.log(chance) / np.log(np.minimum(at_most, 1.0 - 1e-15)))
        most.append(np.minimum(count, UNLIMITED).astype(np.int64))
    return most[0], most[1]


@cache  # computed at every tare, during which a server sends no frames
def _compute_repeat_chances() -> tuple[Floats, Floats]:
    """Compute the largest chance of a repeat, by either share."""
    shares = np.arange(SHARE_STEPS + 1) / SHARE_STEPS
    steps = np.geomspace(_STEP_MAX, _STEP_MIN, 2000)
    by_repeats = np.interp(shares, compute_step_share(steps, 0), steps)
    twos = compute_step_share(steps, 2)
    rising = slice(int(np.argmax(twos)), None)  # with much noise they are few again
    by_twos = np.interp(shares, twos[rising][::-1], steps[rising][::-1])
    by_twos[0] = _STEP_MIN
    at_most = [np.array([math.erf(0.5 / d) for d in step]) for step in (by_repeats, by_twos)]
    return at_most[0], at_most[1]


def compute_step_share(step_sigma_counts: Floats, step_counts: int) -> Floats:
    """Compute the share of steps of `step_counts` from the unrounded steps' standard deviation.

    Rounding makes a difference of d counts one of n with the chance 1 - |d - n|.
    """
    ends = (step_counts + np.array([[-1.0], [0.0], [1.0]])) / step_sigma_counts
    below = 0.5 * (1.0 + np.array([[math.erf(e / math.sqrt(2.0)) for e in row] for row in ends]))
    density = np.exp(-0.5 * ends**2) / math.sqrt(2.0 * math.pi)
    low, high = np.diff(below, axis=0)
    mean_low, mean_high = -np.diff(density, axis=0) * step_sigma_counts
    one_side = (1 - step_counts) * low + mean_low + (1 + step_counts) * high - mean_high
    return np.asarray(one_side if step_counts == 0 else 2.0 * one_side)


def _compute_unrounded_step_sigma_counts(noise_counts: Floats, correlation: float) -> Floats:
    """Compute the standard deviation of unrounded steps without outliers, from the noise."""
    # Rounding adds noise, but no change of the count.
    latent = np.sqrt(np.maximum(noise_counts**2 - 1.0 / 12.0, 0.0))
    return np.maximum(
        NOISE_WITHOUT_OUTLIERS * latent * math.sqrt(2.0 * (1.0 - correlation)), _STEP_MIN
    )


def make_stuck_params(
    noise_counts: Floats, rate_hz: float
) -> tuple[RecordArray[StuckParams], RecordArray[EqualCountLimits]]:
    """Make the parameters (tiles,) and the limits (1,).

    Args:
        noise_counts: (tiles,), noise at the tare, in counts with outliers and rounding.
        rate_hz: of the frames.
    """
    by_equal, by_double_step = _compute_limit_tables(rate_hz, len(noise_counts))
    supposed = _compute_unrounded_step_sigma_counts(
        noise_counts, math.exp(-1.0 / (rate_hz * PRIOR_CORRELATION_S))
    )
    white = np.ceil(
        compute_step_share(_compute_unrounded_step_sigma_counts(noise_counts, 0.0), 0) * SHARE_STEPS
    ).astype(np.int64)
    params = StuckParams.array(
        len(noise_counts),
        equal_share=compute_step_share(supposed, 0),
        double_step_share=compute_step_share(supposed, 2),
        equal_count_max=by_equal[np.minimum(white, SHARE_STEPS)],
    )
    limits = EqualCountLimits.array(
        1, max_by_equal_share=by_equal, max_by_double_step_share=by_double_step
    )
    return params, limits


@jit_cached
def update_stuck_and_load_changes(
    limits: EqualCountLimits,
    params: StuckParams,
    state: StuckState,
    pressure_raw: int,
    above_kpa: float,
    unloaded_band_kpa: float,
    load_changes: int,
    tiles: int,
) -> tuple[bool, int]:
    """Update the state; return whether noise does not explain a repeat, and `load_changes`.

    Args:
        limits: of the array.
        params: of the tile.
        state: after the tile's readings before; updated.
        pressure_raw: count.
        above_kpa: pressure above the baseline; NaN where none was readable, or where it is so great
            that a healthy chip may stand still.
        unloaded_band_kpa: distance from the baseline within which a tile counts as unloaded.
        load_changes: number of loadings and unloadings of all tiles before.
        tiles: number of tiles.
    """
    if math.isnan(above_kpa):
        state.was_unloaded = 0
        return False, load_changes
    step = abs(pressure_raw - state.pressure_raw)
    unloaded = abs(above_kpa) < unloaded_band_kpa
    is_loaded = 1 if above_kpa > 2.0 * unloaded_band_kpa else (0 if unloaded else state.is_loaded)
    if is_loaded != state.is_loaded:
        load_changes += 1
        state.is_loaded = is_loaded
    if step == 0:
        state.equal_count += 1
    else:
        state.pressure_raw, state.equal_count = pressure_raw, 1
        state.changes_at_start = load_changes
    stuck = False
    if state.equal_count > EQUAL_COUNT_MIN:
        weight = PRIOR_PAIRS + state.unloaded_pairs
        share = (PRIOR_PAIRS * params.equal_share + state.equal_pairs) / weight
        share += SHARE_MARGIN_SIGMAS * math.sqrt(share * (1.0 - share) / weight)
        two = (PRIOR_PAIRS * params.double_step_share + state.double_step_pairs) / weight
        two -= SHARE_MARGIN_SIGMAS * math.sqrt(two * (1.0 - two) / weight)
        limit = max(
            params.equal_count_max,
            limits.max_by_equal_share[min(math.ceil(share * SHARE_STEPS), SHARE_STEPS)],
            limits.max_by_double_step_share[max(int(two * SHARE_STEPS), 0)],
        )
        others = load_changes - state.changes_at_start
        stays_loaded = (
            is_loaded == 1 and tiles > 1 and others >= 2 * LOADINGS_OF_OTHERS * (tiles - 1)
        )
        stuck = state.equal_count >= limit or stays_loaded
    if unloaded and state.was_unloaded == 1 and not stuck:
        state.unloaded_pairs += 1
        state.equal_pairs += 1 if step == 0 else 0
        state.double_step_pairs += 1 if step == 2 else 0
        if state.unloaded_pairs > PAIRS_MAX:
            state.unloaded_pairs //= 2
            state.equal_pairs //= 2
            state.double_step_pairs //= 2
    state.was_unloaded = 1 if unloaded else 0
    return stuck, load_changes
