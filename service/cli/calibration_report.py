"""Calibrations, also of mounted feet, as tables for people and as JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.effects import Effects, Parameter
from service.estimation.fitting.least_squares import compute_student_t_95
from service.estimation.models.hysteresis import WIDTHS_N
from service.estimation.records import SIGMAS_95

if TYPE_CHECKING:
    from service.offline.mount_calibration import MountCalibrationResult


def make_calibration_tables(calibration: Calibration) -> list[Table]:
    """Return tables of the tiles' curves, ranges, effects and dead weights."""
    tiles = [tile for tile in calibration.tiles if tile.weights is not None]
    weighed = [_tabulate_weights(calibration, tile) for tile in tiles]
    if len(weighed) == len(calibration.tiles):
        return weighed
    rig_tables = (_tabulate_curves, _tabulate_ranges, _tabulate_effects)
    return [*(tabulate(calibration) for tabulate in rig_tables), *weighed]


def _tabulate_weights(calibration: Calibration, tile: TileCalibration) -> Table:
    """Return a table of the weights on a tile, with residual and interval of each."""
    facts = tile.weights
    assert facts is not None  # noqa: S101  # checked by the caller
    table = _make_table(
        f"Tile {tile.serial}, {len(facts.steps)} weights",
        [
            "pressure: above the rest before it;",
            "settled: last second less the first;",
            "residual: the curve less the weight;",
            "95 %: half width of the interval, which holds",
            "95 of 100 other loads that have settled;",
            "a fast load is not in it: gas adds 10 to 20 %",
            "for some 50 ms",
            f"reference: {calibration.reference}; {calibration.date}",
        ],
        *("weight", "force\nN", "pressure\nkPa", "noise\nkPa", "settled\nkPa"),
        *("residual\nN", "95 %\nN"),
    )
    for step in sorted(facts.steps, key=lambda step: step.force_n):
        table.add_row(
            escape(step.weight),
            _format_number(step.force_n, 2),
            _format_number(step.gauge_kpa, 2),
            f"{step.noise_kpa:.{2 if step.noise_kpa >= 0.01 else 4}f}",
            f"{step.settle_kpa:+.2f}",
            f"{step.residual_n:+.2f}",
            f"±{facts.interpolate_half_width_95_n(step.gauge_kpa):.2f}",
        )
    return table


def _make_table(title: str, notes: Sequence[str], *headings: str) -> Table:
    table = Table(
        title=escape(title),
        caption=escape("\n".join(notes)),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for heading in headings:
        table.add_column(
            heading, justify="left" if heading in ("", "tile", "weight") else "right", no_wrap=True
        )
    return table


def _tabulate_curves(calibration: Calibration) -> Table:
    table = _make_table(
        f"Calibration {calibration.name} ({calibration.id})",
        [
            "of mean: R2 of the mean of all repeats; left out: error on a repeat the",
            "fit has not seen; mean, new: half width at full load of the 95 % band of",
            "the mean curve, and of a new loading; loop: hysteresis",
            f"reference: {calibration.reference}; {calibration.date}",
        ],
        *("tile", "R2", "of mean", "RMSE\nN", "left out\nN", "mean\nN", "new\nN", "loop\nN"),
        *("rises", "repeats"),
    )
    for tile in calibration.tiles:
        facts = tile.rig
        last = facts.band_95[-1] if facts is not None else None
        files = f" in {facts.recordings}" if facts is not None and facts.recordings > 1 else ""
        table.add_row(
            tile.serial,
            _format_number(tile.r2, 4),
            _format_number(None if facts is None else facts.r2_of_mean, 5),
            _format_number(tile.rmse_n, 2),
            _format_number(tile.cv_rmse_n, 2),
            _format_number(None if last is None else last.mean_n, 2),
            _format_number(None if last is None else last.new_loading_n, 2),
            _format_number(tile.hysteresis_n, 2),
            "yes" if tile.monotonic else "NO",
            f"{tile.repeats}{files}",
        )
    return table


def _tabulate_ranges(calibration: Calibration) -> Table:
    table = _make_table(
        "Range",
        [
            "end: where the range ends, above the baseline, absolute, and as a force;",
            "ended by: the load, which went no further, or the chip, whose reading did not",
        ],
        *("tile", "end\nkPa", "absolute\nkPa", "left to\nchip's kPa", "force\nN", "ended by"),
        *("drift\nkPa", "raw T\ncounts", "about\ndegC"),
    )
    for tile in calibration.tiles:
        facts = tile.rig
        if facts is None:
            table.add_row(tile.serial, _format_number(tile.range_kpa[1], 2), *["-"] * 7)
            continue
        table.add_row(
            tile.serial,
            _format_number(tile.range_kpa[1], 2),
            _format_number(facts.end_absolute_kpa, 2),
            _format_number(facts.spare_kpa, 2),
            _format_number(facts.end_n, 1),
            facts.ended_by,
            _format_number(facts.baseline_drift_kpa, 2),
            _format_number(facts.temperature_raw_counts, 0),
            _format_number(facts.degc, 0),
        )
    return table


def _tabulate_effects(calibration: Calibration) -> Table:
    table = _make_table(
        "Beside the curve",
        [
            "each with half its 95 % interval; creep: parts of the force, and their times;",
            "gas lag: behind its chip, negative where the chip is behind",
            *(
                f"{tile.serial}: sampled {_format_interval(late_s, 0, 1e6)} us later than assumed"
                for tile in calibration.tiles
                if (late_s := tile.effects.late_s) is not None
            ),
            *(
                f"{tile.serial}: no {name}: {reason}"
                for tile in calibration.tiles
                for name, reason in tile.effects.refused.items()
            ),
            *(
                f"{tile.serial}: {name} is at the end of what is possible"
                for tile in calibration.tiles
                for name in tile.effects.at_bound
            ),
        ],
        *("tile", "gas\ngamma", "gas tau\nms", "creep\n%", "creep\ns", "half loop\nN"),
        *("warmth\nkPa/K", "gas lag\ns"),
    )
    for tile in calibration.tiles:
        effects = tile.effects
        gas, rubber, warm = effects.gas, effects.rubber, effects.temperature
        table.add_row(
            tile.serial,
            _format_interval(gas.gamma, 2) if gas else "-",
            _format_interval(gas.tau_s, 1, 1e3) if gas else "-",
            "\n".join(_format_interval(part, 1, 100.0) for part in rubber.part) if rubber else "-",
            "\n".join(_format_interval(tau, 2) for tau in rubber.tau_s) if rubber else "-",
            _format_interval(loop, 2) if (loop := compute_loop_half_width_n(effects)) else "-",
            _format_interval(warm.kpa_per_k, 3) if warm else "-",
            _format_interval(warm.lag_s, 1) if warm else "-",
        )
    return table


def compute_loop_half_width_n(effects: Effects) -> Parameter | None:
    """Return the half width of a fully open hysteresis loop, in a slow stroke.

    It is the sum of the plays' parts times their half widths, and the stress of the flowing branch.
    Its uncertainty assumes independent terms, which is conservative: they are anticorrelated.
    """
    if effects.hysteresis is None:
        return None
    parts = list(zip(effects.hysteresis.part, WIDTHS_N.tolist(), strict=False))
    if (flow := effects.hysteresis.flow) is not None:
        parts.append((flow.stress_n, 1.0))
    return Parameter(
        value=sum(part.value * width for part, width in parts),
        sigma=sum((part.sigma * width) ** 2 for part, width in parts) ** 0.5,
    )


def make_calibration_json(calibration: Calibration) -> dict[str, object]:
    """Return the quality of a calibration for programs."""
    return {
        "id": calibration.id,
        "name": calibration.name,
        "reference": calibration.reference,
        "date": calibration.date,
        "tiles": [_make_tile_json(tile) for tile in calibration.tiles],
        "refused": calibration.refused,
    }


_TILE_FIELDS = {
    *("serial", "r2", "rmse_n", "cv_rmse_n", "hysteresis_n", "range_kpa", "monotonic"),
    *("coefficients", "absolute_scale", "repeats", "covariance", "baseline_kpa", "noise_kpa"),
    *("rig", "weights"),
}


def _make_tile_json(tile: TileCalibration) -> dict[str, object]:
    effects = tile.effects
    gas, rubber, warm = effects.gas, effects.rubber, effects.temperature
    gamma, tau = (gas.gamma, gas.tau_s) if gas else (None, None)
    kpa_per_k, lag = (warm.kpa_per_k, warm.lag_s) if warm else (None, None)
    return {
        **tile.model_dump(mode="json", include=_TILE_FIELDS),
        "student_t_95": compute_student_t_95(tile.repeats) if tile.repeats > 1 else None,
        "effects": {
            "late_us": _make_parameter_json(effects.late_s, 1e6),
            "late_common_sigma_us": 1e6 * effects.late_common_s,
            "reference_late_us": 1e6 * effects.reference_late_s,
            "gamma": _make_parameter_json(gamma),
            "gas_tau_ms": _make_parameter_json(tau, 1e3),
            "creep_part": [_make_parameter_json(part) for part in rubber.part] if rubber else None,
            "creep_time_s": [_make_parameter_json(tau) for tau in rubber.tau_s] if rubber else None,
            "loop_half_width_n": _make_parameter_json(compute_loop_half_width_n(effects)),
            "kpa_per_k": _make_parameter_json(kpa_per_k),
            "gas_lag_s": _make_parameter_json(lag),
            "at_bound": list(effects.at_bound),
            "refused": dict(effects.refused),
        },
    }


def _make_parameter_json(
    parameter: Parameter | None, factor: float = 1.0
) -> dict[str, object] | None:
    if parameter is None:
        return None
    low, high = parameter.interval_95
    return {"value": factor * parameter.value, "interval_95": [factor * low, factor * high]}


def _format_interval(parameter: Parameter, digits: int, factor: float = 1.0) -> str:
    half = SIGMAS_95 * factor * parameter.sigma
    if 0.0 < half < 0.5 * 10.0**-digits:  # of a quiet chip
        digits = -math.floor(math.log10(half))
    return f"{factor * parameter.value:.{digits}f}±{half:.{digits}f}"


def _format_number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def make_mount_json(found: MountCalibrationResult) -> dict[str, object]:
    """Return the calibration of a mounted foot for programs."""
    mounted, mount = found.calibration.mounted, found.mount_fit
    return {
        "id": found.calibration.id,
        "reference": None if mounted is None else mounted.reference,
        "gains": {}
        if mounted is None
        else {serial: _make_mount_parameter_json(gain) for serial, gain in mounted.gains.items()},
        "shear": None if mount.shear is None else _make_mount_parameter_json(mount.shear),
        "mae_before_n": mount.mae_before_n,
        "mae_after_n": mount.mae_after_n,
        "frames": mount.frame_count,
        "blocks": mount.block_count,
        "late_s": _make_mount_parameter_json(mount.residual_lag_s),
    }


def _make_mount_parameter_json(found: Parameter) -> dict[str, object]:
    return {"value": found.value, "sigma": found.sigma, "interval_95": found.interval_95}


def make_mount_table(found: MountCalibrationResult) -> Table:
    """Return a table of the gains and the shear of a mounted foot."""
    mounted, mount = found.calibration.mounted, found.mount_fit
    table = _make_table(
        f"Calibration {found.calibration.name} ({found.calibration.id}), as mounted",
        [
            f"GRF under load, mean absolute error: {mount.mae_before_n:.3f} N before, "
            f"{mount.mae_after_n:.3f} N after,",
            f"each stretch by a fit to the others; {mount.frame_count} frames",
        ],
        *("", "value", "95 % interval"),
    )
    rows = [] if mounted is None else [(f"gain {name}", one) for name, one in mounted.gains.items()]
    if mount.shear is not None:
        rows.append(("shear", mount.shear))
    for name, found_one in rows:
        low, high = found_one.interval_95
        table.add_row(name, f"{found_one.value:.4f}", f"{low:.4f} to {high:.4f}")
    return table
