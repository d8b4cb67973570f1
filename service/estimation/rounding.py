"""Estimates rounded to what they tell: their noise below an eighth of its least sigma is not kept.

A float32 has 24 bits for a force of which five or six are more than noise, and noise does not
compress. So each column has one step, a power of two, for the whole of a recording, known before
its first frame from calibration and tares alone. A step of sigma/8 has a standard deviation of
sigma/28, and makes of sigma 0.07 % more.

The least sigma of every column is worked out from the same terms as the estimate's own, each at
its least; none of them can make it less:

- a pressure's is that of its tile's noise;
- a force's is that of noise averaged over as many readings as can be in a window, the baseline's
  and the curve's own, where in the tile's range that is least; a GRF's is that of its tiles;
- a centre of pressure's is that of those forces over the greatest sum of forces there can be;
- an angle's is that of one count, of which a servo tells no parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from service.estimation.ladder.plan import EstimationPlan
from service.estimation.models.denoise import AVERAGED_MAX, PAST_NS

PART = 8.0
"""A step is at most the least sigma over this."""
_RATE_MORE = 1.25
"""A window may have so many more readings than the nominal rate says: a bus catches up."""
_PLACES = 1025
"""Of each tile's range, at which the least sigma of its force is looked for."""
_STEP_LEAST = 2.0**-500
"""Below it a quotient may be infinite; and no estimate has a digit there."""
_DOWN = frozenset({"grf_at_least_n"})
"""A bound is rounded down, and remains one."""
_BY_TILE = frozenset({"gauge_kpa", "force_n", "force_sigma_n"})

Columns = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Rounding:
    """The step of every column that is rounded.

    Attributes:
        steps: by name of `Estimates`, one for each tile or one for all, (tiles,) or (1,); 0: is not
            rounded.
    """

    steps: Mapping[str, Floats] = field(default_factory=dict)

    @classmethod
    def of(cls, plans: Iterable[EstimationPlan]) -> Self:
        """The steps that go with all estimates of a recording.

        Args:
            plans: of all its tares; those of a tare that is lost give no numbers to be rounded.
        """
        least = [_least_sigmas(plan) for plan in plans if not plan.tare.is_lost]
        names = least[0] if least else ()
        return cls({name: _steps([each[name] for each in least]) for name in names})

    def rounded(self, columns: Columns) -> dict[str, npt.NDArray[Any]]:
        """Columns of estimates, (n,) or (n, tiles), each to a multiple of its step.

        Other columns, NaN and infinity are as they were; zero has no sign.
        """
        return {
            name: _rounded(values, self.steps[name], down=name in _DOWN)
            if name in self.steps
            else values
            for name, values in columns.items()
        }

    def by_column(self) -> dict[str, float]:
        """For a file: the step of each flat column that is rounded, in the column's unit."""
        return {
            f"{name}_{i}" if name in _BY_TILE else name: float(step)
            for name, steps in self.steps.items()
            for i, step in enumerate(steps)
            if step > 0.0
        }


def _rounded(values: npt.NDArray[Any], step: Floats, *, down: bool) -> npt.NDArray[Any]:
    divisor = np.where(step > 0.0, step, 1.0)
    whole = (np.floor if down else np.rint)(values / divisor) * divisor + 0.0
    return np.asarray(np.where(step > 0.0, whole, values))


def _steps(least: Sequence[Floats]) -> Floats:
    """The greatest powers of two that are small enough for each; 0 where there is no sigma."""
    most = np.min(np.stack(least), axis=0) / PART
    usable = np.isfinite(most) & (most >= _STEP_LEAST)
    exponent = np.frexp(np.where(usable, most, 1.0))[1] - 1
    return np.where(usable, np.ldexp(1.0, exponent), 0.0)


def _least_sigmas(plan: EstimationPlan) -> dict[str, Floats]:
    """Of each column, what its standard uncertainty is at least."""
    tare = plan.tare
    reading_kpa = np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    of_tile_n = _least_tile_n(plan)
    force_n = np.full(len(plan.info.tiles), np.nan)
    force_n[plan.bearing] = of_tile_n
    grf_n = np.array([math.sqrt(float((of_tile_n**2).sum()))])
    most_kpa = float(plan.ladder.curves.high_kpa.sum())
    end_n = plan.ladder.curves.force(plan.ladder.curves.high_kpa[None]).force_n
    most_n = float((plan.gain * end_n).sum())
    least = {"gauge_kpa": reading_kpa, "force_n": force_n, "force_sigma_n": force_n}
    least |= dict.fromkeys(("grf_n", "grf_sigma_n", "grf_at_least_n"), grf_n)
    for name, is_measured, places_m in zip("xy", plan.cop_measured, plan.bearing_m.T, strict=False):
        sigma_m = of_tile_n.min() * _extent(places_m) / most_n if is_measured else math.nan
        names = f"cop_{name}_m", f"cop_sigma_{name}_m", f"cop_ground_{name}_m"
        least |= dict.fromkeys(names, np.array([sigma_m]))
    if plan.grid is not None:
        noise_kpa = float(tare.noise_kpa[plan.bearing].min())
        i, j = (noise_kpa * _extent(index) / most_kpa for index in plan.grid)
        least |= {"cop_index_x": np.array([i or j]), "cop_index_y": np.array([j or i])}
    if (servo := plan.info.servo) is not None:
        count_rad = abs(servo.ratio) * 2.0 * math.pi / servo.counts_per_turn
        least["angle_rad"] = np.array([count_rad / math.sqrt(12.0)])
    return least


def _least_tile_n(plan: EstimationPlan) -> Floats:
    """Of the force on each bearing tile: over its range, with all the averaging there can be."""
    curves, left = plan.ladder.curves, np.ones(len(plan.bearing))
    if plan.ladder.denoise:
        within_s = 1e-9 * (PAST_NS + plan.look_ns)
        rate_hz = _RATE_MORE * plan.info.nominal_rate_hz
        readings = min(AVERAGED_MAX, 2 + math.ceil(rate_hz * within_s))
        left = plan.noise_left[:, readings] / readings
    of_pressure_kpa = np.sqrt(left * plan.noise_kpa**2 + plan.baseline_sigma_kpa**2)
    static = curves.force(np.linspace(0.0, 1.0, _PLACES)[:, None] * curves.high_kpa)
    own_n = np.hypot(static.slope_n_per_kpa * of_pressure_kpa, static.fit_sigma_n)
    return np.asarray(plan.gain * own_n.min(axis=0))


def _extent(places: Floats) -> float:
    """What a sigma of 1 of every weight makes of their mean place at least, times their sum."""
    return math.sqrt(float(((places - places.mean()) ** 2).sum()))
