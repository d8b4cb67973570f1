"""A tile that repeats itself: its word stands still for longer than its noise allows.

However a load moves, the chance that a reading is the same count as the one before is at most that
of noise centred on that count. How often a tile does repeat is learnt while it is unloaded, where
nothing else moves it; that takes correlated noise for what it is. So is how often it moves by two
counts, because one that wavers between two may yet be quiet in the middle of one; and a light load
must not pass for noise, so the tare's noise counts as well. From these follows how many equal words
in a row come once in `HOURS` by chance. A tile whose noise is far below a count may repeat for
ever: it is believed, unless it stays at a load while the others are loaded and let go again and
again.

One value for a word is not a value of this instant, so nothing is known of the force: NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from devices.arrays import Floats, Ints
from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

HOURS = 100.0
"""A healthy array is called stuck once in so many hours, if it repeats as often as it has shown."""
CORRELATED_S = 0.010
"""Noise may be correlated over so long until a tile has shown otherwise."""
PRIOR_PAIRS = 50
"""As many pairs of readings is that supposition worth."""
PART_OF_NOISE = 0.75
"""The tare's noise has outliers in it; without them it is a quarter less (hardware.md 1.3)."""
DOUBT = 2.0
"""In standard deviations: how much more often it may repeat than so far."""
SHARES = 256
"""Shares of repeats for which limits are worked out."""
RUN_MIN = 8
"""So few in a row are never looked at."""
LEARNT_MAX = 1 << 14
"""Pairs; then the older ones count half."""
LOADINGS = 5
"""So often are the other tiles loaded and let go, on average, while one that is quiet stays."""
UNLIMITED = 1 << 40
_STEP_MIN, _STEP_MAX = 0.02, 20.0

STATE = record_type(
    [
        ("padc", np.int64),  # the last word; -1 before the first
        ("run", np.int64),  # how often in a row
        ("toggles", np.int64),  # of all tiles when that began
        ("quiet", np.int64),  # was the last reading unloaded?
        ("pairs", np.int64),  # of unloaded readings, one after the other
        ("repeats", np.int64),  # of these, equal
        ("twos", np.int64),  # of these, two counts apart
        ("loaded", np.int64),
    ]
)
"""What is remembered of each tile."""


LAW = record_type([("repeats", np.float64), ("twos", np.float64), ("least", np.int64)])
"""Constants of a tile, as in `Limits`."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, padc=-1)


def limits(rate_hz: float, tiles: int) -> tuple[Ints, Ints]:
    """How many equal words in a row are too many.

    Differences of neighbours of standard deviation d, in counts, are equal, or two counts apart,
    with chances that are solved for d here; noise of d / sqrt(2) then repeats with erf(1 / 2d) at
    most.

    Returns:
        By the share of repeats in 0 to `SHARES`, and by that of steps of two.
    """
    chance = 1.0 / (HOURS * 3600.0 * rate_hz * tiles)
    most = []
    for at_most in _chances_of_repeats():
        run = 1.0 + np.ceil(math.log(chance) / np.log(np.minimum(at_most, 1.0 - 1e-15)))
        most.append(np.minimum(run, UNLIMITED).astype(np.int64))
    return most[0], most[1]


@cache  # a server works them out at every tare, and nobody is told of frames meanwhile
def _chances_of_repeats() -> tuple[Floats, Floats]:
    """The greatest chance of a repeat by the share of repeats, and by that of steps of two."""
    shares = np.arange(SHARES + 1) / SHARES
    steps = np.geomspace(_STEP_MAX, _STEP_MIN, 2000)
    by_repeats = np.interp(shares, apart(steps, 0), steps)
    twos = apart(steps, 2)
    rising = slice(int(np.argmax(twos)), None)  # of great noise they are few again
    by_twos = np.interp(shares, twos[rising][::-1], steps[rising][::-1])
    by_twos[0] = _STEP_MIN
    at_most = [np.array([math.erf(0.5 / d) for d in step]) for step in (by_repeats, by_twos)]
    return at_most[0], at_most[1]


def apart(steps: Floats, counts: int) -> Floats:
    """Share of neighbours so many counts apart, by the standard deviation of their difference.

    Rounding makes a difference of d counts one of n with the chance 1 - |d - n|.
    """
    ends = (counts + np.array([[-1.0], [0.0], [1.0]])) / steps
    below = 0.5 * (1.0 + np.array([[math.erf(e / math.sqrt(2.0)) for e in row] for row in ends]))
    density = np.exp(-0.5 * ends**2) / math.sqrt(2.0 * math.pi)
    low, high = np.diff(below, axis=0)
    mean_low, mean_high = -np.diff(density, axis=0) * steps
    one_side = (1 - counts) * low + mean_low + (1 + counts) * high - mean_high
    return np.asarray(one_side if counts == 0 else 2.0 * one_side)


def step_of(noise_counts: Floats, kept: float) -> Floats:
    """Standard deviation of steps of tiles of such noise, so much of which is left at the next."""
    # What rounding to a count adds is no reason for another count.
    latent = np.sqrt(np.maximum(noise_counts**2 - 1.0 / 12.0, 0.0))
    return np.maximum(PART_OF_NOISE * latent * math.sqrt(2.0 * (1.0 - kept)), _STEP_MIN)


@dataclass(frozen=True)
class Limits:
    """How many equal words in a row are too many.

    Attributes:
        repeats: (tiles,), supposed share of equal neighbours before any is seen.
        twos: (tiles,), that of neighbours two counts apart.
        least: (tiles,), of white noise as at the tare.
        by_repeats: (`SHARES` + 1,), by the share of equal neighbours.
        by_twos: (`SHARES` + 1,), by that of neighbours two counts apart.
    """

    repeats: Floats
    twos: Floats
    least: Ints
    by_repeats: Ints
    by_twos: Ints

    def laws(self) -> Records:
        """What differs from tile to tile."""
        return records(
            LAW, len(self.repeats), repeats=self.repeats, twos=self.twos, least=self.least
        )


def make_limits(noise_counts: Floats, rate_hz: float) -> Limits:
    """The limits of tiles with such noise at the tare, outliers and rounding in it, in counts."""
    by_repeats, by_twos = limits(rate_hz, len(noise_counts))
    supposed = step_of(noise_counts, math.exp(-1.0 / (rate_hz * CORRELATED_S)))
    white = np.ceil(apart(step_of(noise_counts, 0.0), 0) * SHARES).astype(np.int64)
    return Limits(
        repeats=apart(supposed, 0),
        twos=apart(supposed, 2),
        least=by_repeats[np.minimum(white, SHARES)],
        by_repeats=by_repeats,
        by_twos=by_twos,
    )


@compiled
def is_stuck(
    scene: Record,
    law: Record,
    tile: Record,
    word: int,
    above_kpa: float,
    unloaded_kpa: float,
    toggles: int,
    tiles: int,
) -> tuple[bool, int]:
    """Is a reading a repeat that noise does not explain?

    Args:
        scene: with `by_repeats` and `by_twos` of `Limits`.
        law: constants of the tile.
        tile: state from its readings before; becomes that after this one.
        word: `padc`.
        above_kpa: pressure above the baseline; NaN where none could be read, or where it is so
            great that a chip may stand still, and is no tile that repeats itself.
        unloaded_kpa: so near the baseline no load is seen.
        toggles: how often tiles have been loaded and let go so far, all together.
        tiles: how many there are.

    Returns:
        Whether it is, and how often tiles have been loaded and let go.
    """
    if math.isnan(above_kpa):
        tile.quiet = 0
        return False, toggles
    step = abs(word - tile.padc)
    quiet = abs(above_kpa) < unloaded_kpa
    loaded = 1 if above_kpa > 2.0 * unloaded_kpa else (0 if quiet else tile.loaded)
    if loaded != tile.loaded:
        toggles += 1
        tile.loaded = loaded
    if step == 0:
        tile.run += 1
    else:
        tile.padc, tile.run, tile.toggles = word, 1, toggles
    found = False
    if tile.run > RUN_MIN:
        weight = PRIOR_PAIRS + tile.pairs
        share = (PRIOR_PAIRS * law.repeats + tile.repeats) / weight
        share += DOUBT * math.sqrt(share * (1.0 - share) / weight)
        two = (PRIOR_PAIRS * law.twos + tile.twos) / weight
        two -= DOUBT * math.sqrt(two * (1.0 - two) / weight)
        limit = max(
            law.least,
            scene.by_repeats[min(math.ceil(share * SHARES), SHARES)],
            scene.by_twos[max(int(two * SHARES), 0)],
        )
        others = toggles - tile.toggles
        held = loaded == 1 and tiles > 1 and others >= 2 * LOADINGS * (tiles - 1)
        found = tile.run >= limit or held
    if quiet and tile.quiet == 1 and not found:
        tile.pairs += 1
        tile.repeats += 1 if step == 0 else 0
        tile.twos += 1 if step == 2 else 0
        if tile.pairs > LEARNT_MAX:
            tile.pairs //= 2
            tile.repeats //= 2
            tile.twos //= 2
    tile.quiet = 1 if quiet else 0
    return found, toggles
