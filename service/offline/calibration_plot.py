"""Plot of a calibration: curve, residuals and response to fast loads of each tile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.fitting.effects_fit import ReplaySection, simulate_release_and_tap_pressure
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
    compute_new_loading_half_width_95_n,
)
from service.estimation.fitting.rig.indentation import (
    Indentation,
    average_stroke_blocks,
    select_loaded,
)
from service.offline.figure_output import create_figure, render_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito: distinct for any colour vision, and by shape.
BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
BRANCHES = ((True, "loading", BLUE, "o"), (False, "unloading", VERMILION, "^"))
MAX_TILES_PER_LINE = 4
"""Tiles per line of the figure."""
FAST_LOADS = {"release": "release of a held load", "tap": "tap"}
_HEIGHTS = (3.0, 1.5, 1.5, 1.5)
_LETTERS_PER_IN = 11.0


def plot_calibration(
    calibration: Calibration, recordings: Mapping[str, Sequence[Indentation]]
) -> bytes:
    """Draw curve, bands, residuals and fast loads of every tile as a PNG.

    Args:
        calibration: the fitted calibration.
        recordings: recordings behind the fit, by serial.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    tiles = calibration.tiles
    fast = {
        tile.serial: simulate_release_and_tap_pressure(recordings[tile.serial], tile)
        for tile in tiles
    }
    kinds = [kind for kind in FAST_LOADS if any(kind in found for found in fast.values())]
    lines = [tiles[i : i + MAX_TILES_PER_LINE] for i in range(0, len(tiles), MAX_TILES_PER_LINE)]
    columns = min(MAX_TILES_PER_LINE, len(tiles))
    heights = _HEIGHTS[: 2 + len(kinds)]
    width_in = max(6.4, 1.2 + 3.7 * columns)
    figure = create_figure(width_in, 1.0 + len(lines) * 1.15 * sum(heights))
    title = (
        f"Calibration {calibration.name} ({calibration.id}), {calibration.date[:10]}, "
        f"reference: {calibration.reference}"
    )
    figure.suptitle(fill(title, round(_LETTERS_PER_IN * width_in)), fontsize=10)
    blocks = figure.subfigures(len(lines), 1, squeeze=False)[:, 0]
    for block, line in zip(blocks, lines, strict=True):
        axes = block.subplots(
            len(heights), columns, squeeze=False, gridspec_kw={"height_ratios": heights}
        )
        for column, tile in enumerate(line):
            own = axes[:, column]
            _plot_curve(own[0], own[1], tile, recordings[tile.serial])
            for axis, kind in zip(own[2:], kinds, strict=True):
                _plot_fast_load(axis, kind, fast[tile.serial].get(kind))
        for column in range(len(line), columns):
            for axis in axes[:, column]:
                axis.set_visible(False)
        axes[0, 0].set_ylabel("reference force, N")
        axes[1, 0].set_ylabel("residual, N")
        for axis in axes[2:, 0]:
            axis.set_ylabel("gauge pressure, kPa")
        for row in axes:
            _share_scale(row[: len(line)])
        axes[0, 0].legend(markerscale=2.5, fontsize=7.5, loc="upper left", framealpha=0.9)
        for axis in axes[2:, 0]:
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=7.5, loc="upper right", framealpha=0.9)
    return render_png(figure)


def _plot_curve(
    curve: Axes, residual: Axes, tile: TileCalibration, recordings: Sequence[Indentation]
) -> None:
    blocks = average_stroke_blocks(*select_loaded(recordings))
    end_kpa = tile.range_kpa[1]
    grid_kpa = np.linspace(0.0, end_kpa, 200)
    force_n = compute_curve_through_zero_n(tile, grid_kpa)
    mean_n, new_n = (
        compute_mean_curve_half_width_95_n(tile, grid_kpa),
        compute_new_loading_half_width_95_n(tile, grid_kpa),
    )
    left_n = blocks.force_n - compute_curve_through_zero_n(tile, blocks.gauge_kpa)
    for axis, centre_n in ((curve, force_n), (residual, np.zeros_like(force_n))):
        for half_n, shade, name in (
            (new_n, "#DDDDDD", "95 % of new loadings"),
            (mean_n, "#AAAAAA", "95 % of the mean curve"),
        ):
            low_n, high_n = centre_n - half_n, centre_n + half_n
            axis.fill_between(grid_kpa, low_n, high_n, color=shade, linewidth=0, label=name)
        for loading, name, colour, marker in BRANCHES:
            rows = blocks.loading == loading
            values_n = blocks.force_n if axis is curve else left_n
            axis.plot(
                blocks.gauge_kpa[rows],
                values_n[rows],
                marker,
                color=colour,
                markersize=2.5,
                markeredgewidth=0,
                label=name,
            )
        axis.plot(grid_kpa, centre_n, color="black", linewidth=1.2, label="cubic")
        axis.axvline(end_kpa, color="black", linewidth=0.9, linestyle="--", label="end of range")
        axis.set_xlim(-0.03 * end_kpa, 1.12 * end_kpa)
        axis.grid(alpha=0.25)
    curve.tick_params(labelbottom=False)
    residual.set_xlabel("gauge pressure, kPa")
    facts = tile.rig
    end = f"range to {end_kpa:.2f} kPa"
    if facts is not None:
        beyond = "left to" if facts.spare_kpa >= 0.0 else "beyond"
        chip_kpa = f"{facts.end_absolute_kpa + facts.spare_kpa:.0f}"
        end += (
            f" ({facts.end_n:.1f} N), {abs(facts.spare_kpa):.2f} kPa {beyond} the chip's {chip_kpa}"
        )
        for axis in (curve, residual):
            axis.axvline(
                end_kpa + facts.spare_kpa, color=GREEN, linestyle=":", label=f"{chip_kpa} kPa"
            )
    curve.set_title(
        f"{tile.serial}: R² {_format_number(tile.r2, 4)}, RMSE {_format_number(tile.rmse_n, 2)} N\n"
        f"left-out repeat {_format_number(tile.cv_rmse_n, 2)} N, "
        f"loop {_format_number(tile.hysteresis_n, 2)} N\n"
        f"{end}",
        fontsize=8.5,
    )


def _plot_fast_load(axis: Axes, kind: str, replay: ReplaySection | None) -> None:
    axis.grid(alpha=0.25)
    axis.set_title(FAST_LOADS[kind], fontsize=8.5)
    axis.set_xlabel("time, ms")
    if replay is None:
        axis.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=axis.transAxes)
        return
    time_ms = replay.t_s * 1e3
    axis.plot(
        time_ms,
        replay.measured_kpa,
        "o",
        color=BLUE,
        markersize=3,
        markeredgewidth=0,
        label="measured",
    )
    axis.plot(
        time_ms,
        replay.static_kpa,
        color=GREY,
        linewidth=1.1,
        linestyle="--",
        label="curve alone",
    )
    axis.plot(time_ms, replay.modelled_kpa, color=VERMILION, linewidth=1.4, label="with effects")


def _share_scale(axes: Sequence[Axes]) -> None:
    """Give adjacent tiles the same y scale, labelled once."""
    low = min(axis.get_ylim()[0] for axis in axes)
    high = max(axis.get_ylim()[1] for axis in axes)
    for i, axis in enumerate(axes):
        axis.set_ylim(low, high)
        axis.tick_params(labelleft=i == 0)


def _format_number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
