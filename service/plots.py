"""Plots for people. matplotlib is an extra: `pip install '.[plot]'`."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import UsageError
from service.calibrate import read_indentations
from service.estimation.calibration import Calibration
from service.estimation.indentation import Indentation, strokes
from service.estimation.models.static import StaticCurves
from storage.session_file import SessionReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INTERVAL_95 = 1.96
DPI = 120


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of that size in inches.

    Raises:
        UsageError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError(
            "plots need matplotlib", remedy="Install the extra: pip install '.[plot]'"
        ) from error
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png_of(figure: Figure) -> bytes:
    """A figure as a PNG."""
    png = BytesIO()
    figure.savefig(png, dpi=DPI, format="png")
    return png.getvalue()


def plot_calibration(calibration: Calibration, recordings: Sequence[Path]) -> bytes:
    """Curve with 95 % band, measured strokes and residuals of every tile, as a PNG.

    Raises:
        UsageError: matplotlib is not installed.
    """
    indentations: dict[str, Indentation] = {}
    for path in recordings:
        with SessionReader(path) as session:
            indentations |= {tile.serial: tile for tile in read_indentations(session)}
    tiles = calibration.tiles
    figure = new_figure(1.0 + 3.4 * len(tiles), 5.6)
    axes = figure.subplots(
        2,
        len(tiles),
        squeeze=False,
        sharex="col",
        sharey="row",
        gridspec_kw={"height_ratios": [3, 1.4]},
    )
    for (curve_axis, residual_axis), tile in zip(axes.T, tiles, strict=True):
        curves = StaticCurves([tile])
        blocks = strokes(indentations[tile.serial])
        grid_kpa = np.linspace(0.0, tile.range_kpa[1], 200)[:, None]
        fitted = curves.force(grid_kpa)
        band_n = INTERVAL_95 * fitted.fit_sigma_n[:, 0]
        force_n = fitted.force_n[:, 0]
        residual_n = blocks.force_n - curves.force(blocks.gauge_kpa[:, None]).force_n[:, 0]
        for loading, colour, label in (
            (True, "tab:blue", "loading"),
            (False, "tab:orange", "unloading"),
        ):
            rows = blocks.loading == loading
            style = {"marker": ".", "markersize": 3, "linestyle": "none", "color": colour}
            curve_axis.plot(blocks.gauge_kpa[rows], blocks.force_n[rows], label=label, **style)
            residual_axis.plot(blocks.gauge_kpa[rows], residual_n[rows], **style)
        curve_axis.plot(grid_kpa, force_n, color="black", linewidth=1.2, label="cubic")
        curve_axis.fill_between(
            grid_kpa[:, 0],
            force_n - band_n,
            force_n + band_n,
            color="black",
            alpha=0.12,
            label="95 % of new loadings",
        )
        residual_axis.fill_between(grid_kpa[:, 0], -band_n, band_n, color="black", alpha=0.12)
        residual_axis.axhline(0.0, color="black", linewidth=0.8)
        for axis in (curve_axis, residual_axis):
            axis.axvline(tile.range_kpa[1], color="tab:red", linewidth=0.8, linestyle="--")
            axis.grid(alpha=0.25)
        curve_axis.set_title(
            f"{tile.serial}   R² {tile.r2:.4f}\n"
            f"RMSE {tile.rmse_n:.2f} N, left-out repeat {tile.cv_rmse_n:.2f} N",
            fontsize=9,
        )
        residual_axis.set_xlabel("gauge pressure, kPa")
    axes[0, 0].set_ylabel("reference force, N")
    axes[1, 0].set_ylabel("residual, N")
    axes[0, 0].legend(fontsize=8, loc="upper left")
    figure.suptitle(
        f"{calibration.name} ({calibration.id}); reference: {calibration.reference}; "
        "dashed: end of range",
        fontsize=9,
    )
    return png_of(figure)
