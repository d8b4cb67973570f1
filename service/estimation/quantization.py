"""Quantization of estimates to an eighth of their least sigma.

A float32 has 24 bits for a force; only five or six are above the noise, and noise does not
compress. So each column has one step, a power of two, for the whole recording, computed before its
first frame from calibration and tares alone. A step of sigma/8 has a standard deviation of
sigma/28, and raises sigma by 0.07 %.

The least sigma of every column follows from the same terms as the estimate's own, each at its
least:

- a pressure: the noise of its tile;
- a force: noise averaged over the largest number of readings in a window, baseline and curve, at
  the pressure in the tile's range where their sum is least; a GRF: the forces of its tiles;
- a centre of pressure: those forces over the largest possible sum of forces;
- an angle: one count of the servo.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from devices.arrays import Columns, Floats
from service.estimation.models.denoise import PAST_NS, WINDOW_READINGS_MAX
from service.estimation.models.static import compute_forces
from service.estimation.pipeline.plan import EstimationPlan

STEPS_PER_SIGMA = 8.0
"""Least number of steps in the least sigma."""
_RATE_MARGIN = 1.25
"""Largest factor of readings in a window over the nominal rate: a bus catches up."""
_PRESSURES = 1025
"""Number of pressures in each tile's range at which the sigma of its force is computed."""
_STEP_MIN = 2.0**-500
"""Least step; below it a quotient may overflow."""
_ROUNDED_DOWN = frozenset({"grf_lower_bound_n"})
"""Columns that are rounded down: a rounded lower bound remains a lower bound."""
_BY_TILE = frozenset({"gauge_kpa", "force_n", "force_sigma_n"})


@dataclass(frozen=True)
class Quantization:
    """Quantization steps of the columns.

    Attributes:
        steps: by name of `Estimates`, (tiles,) or (1,); 0: not quantized.
    """

    steps: Mapping[str, Floats] = field(default_factory=dict)

    @classmethod
    def for_plans(cls, plans: Iterable[EstimationPlan]) -> Self:
        """Compute the steps for all estimates of a recording.

        Args:
            plans: of all its tares; lost tares give no numbers and are skipped.
        """
        least = [_compute_least_sigmas(plan) for plan in plans if not plan.tare.is_lost]
        names = least[0] if least else ()
        return cls({name: _select_steps([each[name] for each in least]) for name in names})

    def round_to_steps(self, columns: Columns) -> dict[str, npt.NDArray[Any]]:
        """Round columns of estimates, (n,) or (n, tiles), to multiples of their steps.

        Other columns, NaN and infinity are unchanged; zero has no sign.
        """
        return {
            name: _round_to_step(values, self.steps[name], down=name in _ROUNDED_DOWN)
            if name in self.steps
            else values
            for name, values in columns.items()
        }

    def collect_flat_column_steps(self) -> dict[str, float]:
        """Return the step of each quantized flat column, in its unit, for a file's metadata."""
        return {
            f"{name}_{i}" if name in _BY_TILE else name: float(step)
            for name, steps in self.steps.items()
            for i, step in enumerate(steps)
            if step > 0.0
        }


def _round_to_step(values: npt.NDArray[Any], step: Floats, *, down: bool) -> npt.NDArray[Any]:
    divisor = np.where(step > 0.0, step, 1.0)
    whole = (np.floor if down else np.rint)(values / divisor) * divisor + 0.0
    return np.asarray(np.where(step > 0.0, whole, values))


def _select_steps(sigmas: Sequence[Floats]) -> Floats:
    """Return the largest power of two within sigma over `STEPS_PER_SIGMA`; 0 without a sigma."""
    most = np.min(np.stack(sigmas), axis=0) / STEPS_PER_SIGMA
    usable = np.isfinite(most) & (most >= _STEP_MIN)
    exponent = np.frexp(np.where(usable, most, 1.0))[1] - 1
    return np.where(usable, np.ldexp(1.0, exponent), 0.0)


def _compute_least_sigmas(plan: EstimationPlan) -> dict[str, Floats]:
    """Compute the least standard uncertainty of each column."""
    tare = plan.tare
    reading_kpa = np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    of_tile_n = _compute_least_tile_sigmas_n(plan)
    force_n = np.full(len(plan.info.tiles), np.nan)
    force_n[plan.load_bearing_columns] = of_tile_n
    grf_n = np.array([math.sqrt(float((of_tile_n**2).sum()))])
    bearing, curves = plan.load_bearing_params, plan.curves
    most_kpa = float(curves["range_high_kpa"].sum())
    end_n = compute_forces(curves, curves["range_high_kpa"][None]).force_n
    most_n = float((bearing["mount_gain"] * end_n).sum())
    least = {"gauge_kpa": reading_kpa, "force_n": force_n, "force_sigma_n": force_n}
    least |= dict.fromkeys(("grf_n", "grf_sigma_n", "grf_lower_bound_n"), grf_n)
    for name, is_measured, places_m in zip(
        "xy", plan.cop_measured, bearing["position_m"].T, strict=False
    ):
        sigma_m = (
            of_tile_n.min() * _compute_lever_norm(places_m) / most_n if is_measured else math.nan
        )
        names = f"cop_{name}_m", f"cop_sigma_{name}_m", f"cop_ground_{name}_m"
        least |= dict.fromkeys(names, np.array([sigma_m]))
    if plan.params.foot["has_grid"][0]:
        noise_kpa = float(bearing["noise_kpa"].min())
        i, j = (noise_kpa * _compute_lever_norm(k) / most_kpa for k in bearing["grid_index"].T)
        least |= {"cop_index_x": np.array([i or j]), "cop_index_y": np.array([j or i])}
    if (servo := plan.info.servo) is not None:
        count_rad = abs(servo.ratio) * 2.0 * math.pi / servo.counts_per_turn
        least["angle_rad"] = np.array([count_rad / math.sqrt(12.0)])
    return least


def _compute_least_tile_sigmas_n(plan: EstimationPlan) -> Floats:
    """Compute the least sigma of each load-bearing tile's force, over its range, fully averaged."""
    bearing, curves, left = (
        plan.load_bearing_params,
        plan.curves,
        np.ones(len(plan.load_bearing_columns)),
    )
    if "denoise" in plan.models:
        within_s = 1e-9 * (PAST_NS + plan.lookahead_ns)
        rate_hz = _RATE_MARGIN * plan.info.nominal_rate_hz
        readings = min(WINDOW_READINGS_MAX, 2 + math.ceil(rate_hz * within_s))
        left = bearing["variance_inflation"][:, readings] / readings
    of_pressure_kpa = np.sqrt(left * bearing["noise_kpa"] ** 2 + bearing["baseline_variance"])
    static = compute_forces(
        curves, np.linspace(0.0, 1.0, _PRESSURES)[:, None] * curves["range_high_kpa"]
    )
    own_n = np.hypot(static.slope_n_per_kpa * of_pressure_kpa, static.fit_sigma_n)
    return np.asarray(bearing["mount_gain"] * own_n.min(axis=0))


def _compute_lever_norm(places: Floats) -> float:
    """Return the sigma of a weighted mean of places, times the weights' sum, for sigmas of 1."""
    return math.sqrt(float(((places - places.mean()) ** 2).sum()))
