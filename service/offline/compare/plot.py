"""Plot of a comparison: GRF, tiles, COP, and error over force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from devices.arrays import Bools, Floats
from service.estimation.records import SIGMAS_95
from service.offline.compare.error_figures import ComparisonErrors
from service.offline.compare.paired_frames import PairedFrames
from service.offline.figure_output import create_figure, render_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito: distinct for any colour vision.
OUR_COLOUR, REFERENCE_COLOUR = "#0072B2", "#D55E00"
TILE_COLOURS = (
    "#56B4E9",
    "#E69F00",
    "#009E73",
    "#CC79A7",
    "#F0E442",
    "#0072B2",
    "#D55E00",
    "#999999",
)
SHOWN_DURATION_S = 4.0
"""Duration of the time plots, from shortly before the first common contact."""
SHOWN_LEAD_S = 0.2
MAX_POINTS = 5000


def plot_comparison(
    title: str,
    pairs: PairedFrames,
    force_n: Floats,
    serials: Sequence[str],
    errors: ComparisonErrors,
) -> bytes:
    """Draw a comparison as a PNG.

    Args:
        title: title of the figure.
        pairs: our frames with the reference, n of them.
        force_n: (n, tiles), forces of the tiles.
        serials: serials of the tiles.
        errors: source of the limits of agreement.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = create_figure(11.0, 13.5)
    grid = figure.add_gridspec(6, 2, height_ratios=(3, 1.2, 2.6, 2, 1.2, 3.2))
    over_time = [figure.add_subplot(grid[row, :]) for row in range(5)]
    rows = _select_shown(pairs)
    t_s = pairs.t_s[rows]
    figure.suptitle(f"{title}\n{describe_shown_time(t_s, pairs.t_s)}", fontsize=11)
    _plot_grf(over_time[0], over_time[1], pairs, rows)
    _plot_tiles(over_time[2], t_s, force_n[rows], serials, pairs.reference_n[rows])
    _plot_cop(over_time[3], over_time[4], pairs, rows)
    for axis in over_time:
        axis.set_xlim(t_s[0], t_s[-1])
        axis.grid(alpha=0.25)
        axis.tick_params(labelbottom=axis is over_time[-1])
    over_time[-1].set_xlabel("time since the first frame of the session, s")
    _plot_bland_altman(figure.add_subplot(grid[5, 0]), pairs, errors)
    _plot_scatter(figure.add_subplot(grid[5, 1]), pairs)
    figure.align_ylabels(over_time)
    return render_png(figure)


def _select_shown(pairs: PairedFrames) -> Bools:
    both = np.flatnonzero(pairs.reference_contact & (pairs.columns["contact"] == 1))
    begin_s = pairs.t_s[both[0]] - SHOWN_LEAD_S if len(both) else pairs.t_s[0]
    return np.asarray((pairs.t_s >= begin_s) & (pairs.t_s < begin_s + SHOWN_DURATION_S))


def describe_shown_time(shown_s: Floats, all_s: Floats) -> str:
    """Describe the part of the comparison shown in the time plots."""
    shown, whole = (f"{s[0]:.1f} to {s[-1]:.1f} s" for s in (shown_s, all_s))
    if len(shown_s) == len(all_s):
        return f"over time: all that was compared, {whole}"
    return f"over time: {shown}, of {whole} that were compared; below: all of them"


def _plot_grf(force: Axes, error: Axes, pairs: PairedFrames, rows: Bools) -> None:
    t_s, grf_n = pairs.t_s[rows], pairs.columns["grf_n"][rows]
    half_n = SIGMAS_95 * pairs.columns["grf_sigma_n"][rows]
    _plot_band(force, t_s, grf_n, half_n, OUR_COLOUR, "ours, 95 %")
    force.plot(t_s, grf_n, color=OUR_COLOUR, linewidth=1.2, label="ours")
    force.plot(
        t_s, pairs.reference_n[rows], "--", color=REFERENCE_COLOUR, linewidth=1.2, label="reference"
    )
    force.set_ylabel("GRF, N")
    force.legend(fontsize=8, loc="upper right", ncols=3)
    _plot_band(error, t_s, np.zeros(len(t_s)), half_n, OUR_COLOUR)
    error.plot(t_s, pairs.error_n[rows], color="black", linewidth=0.8)
    error.set_ylabel("ours less\nreference, N")


def _plot_band(
    axis: Axes, t_s: Floats, middle: Floats, half: Floats, colour: str, label: str | None = None
) -> None:
    low, high = middle - half, middle + half
    axis.fill_between(t_s, low, high, color=colour, alpha=0.25, linewidth=0, label=label)


def _plot_tiles(
    axis: Axes, t_s: Floats, force_n: Floats, serials: Sequence[str], reference_n: Floats
) -> None:
    borne = [i for i in range(force_n.shape[1]) if np.isfinite(force_n[:, i]).any()]
    if borne:
        # Stacked tiles sum to the GRF; negative forces cannot be stacked.
        heights_n = np.maximum(np.nan_to_num(force_n[:, borne].T), 0.0)
        colours = [TILE_COLOURS[k % len(TILE_COLOURS)] for k in range(len(borne))]
        names = [serials[i] for i in borne]
        axis.stackplot(t_s, heights_n, labels=names, colors=colours, linewidth=0, alpha=0.85)
    axis.plot(t_s, reference_n, "--", color="black", linewidth=1.1, label="reference")
    axis.set_ylabel("tiles, one upon\nanother, N")
    axis.legend(fontsize=8, loc="upper right", ncols=max(1, (len(borne) + 2) // 2))


def _plot_cop(place: Axes, error: Axes, pairs: PairedFrames, rows: Bools) -> None:
    t_s = pairs.t_s[rows]
    theirs_mm = (
        1e3 * np.where(pairs.reference_contact[:, None], pairs.reference_cop_m, np.nan)[rows]
    )
    stated = np.isfinite(theirs_mm).any()
    for k, (name, colour) in enumerate((("x", OUR_COLOUR), ("y", "#009E73"))):
        ours_mm = 1e3 * pairs.columns[f"cop_{name}_m"][rows]
        half_mm = 1e3 * SIGMAS_95 * pairs.columns[f"cop_sigma_{name}_m"][rows]
        _plot_band(place, t_s, ours_mm, half_mm, colour)
        place.plot(t_s, ours_mm, color=colour, linewidth=1.2, label=f"ours, {name}")
        if stated:
            place.plot(t_s, theirs_mm[:, k], "--", color="black", linewidth=0.9 + 0.3 * k)
            off_mm = ours_mm - theirs_mm[:, k]
            error.plot(t_s, off_mm, color=colour, linewidth=0.9, label=name)
            _plot_band(error, t_s, np.zeros(len(t_s)), half_mm, colour)
    if stated:
        place.plot([], [], "--", color="black", label="reference")
        error.axhline(0.0, color="black", linewidth=0.6)
    else:
        error.text(0.5, 0.5, "the reference states none", ha="center", transform=error.transAxes)
    place.set_ylabel("COP, mm")
    place.legend(fontsize=8, loc="upper right", ncols=3)
    error.set_ylabel("ours less\nreference, mm")


def _plot_bland_altman(axis: Axes, pairs: PairedFrames, errors: ComparisonErrors) -> None:
    grf_n, error_n = _select_counted(pairs)
    axis.plot(grf_n - 0.5 * error_n, error_n, ".", color=OUR_COLOUR, markersize=3, alpha=0.35)
    for trial in errors.trials:
        low_n, high_n = trial.limits_of_agreement_n
        for value_n, style in ((trial.figures["grf_bias_n"], "-"), (low_n, "--"), (high_n, "--")):
            axis.axhline(value_n, color="black", linestyle=style, linewidth=0.9)
    axis.set_title("Bland and Altman: bias and limits of agreement of each trial", fontsize=9)
    axis.set_xlabel("mean of ours and reference, N")
    axis.set_ylabel("ours less reference, N")
    axis.grid(alpha=0.25)


def _plot_scatter(axis: Axes, pairs: PairedFrames) -> None:
    grf_n, error_n = _select_counted(pairs)
    axis.plot(grf_n - error_n, grf_n, ".", color=OUR_COLOUR, markersize=3, alpha=0.35)
    end_n = float(grf_n.max()) if len(grf_n) else 1.0
    axis.plot([0.0, end_n], [0.0, end_n], color="black", linewidth=0.9)
    axis.set_title("every judged frame under load", fontsize=9)
    axis.set_xlabel("reference, N")
    axis.set_ylabel("ours, N")
    axis.grid(alpha=0.25)


def _select_counted(pairs: PairedFrames) -> tuple[Floats, Floats]:
    rows = np.flatnonzero(pairs.is_counted & pairs.reference_contact & np.isfinite(pairs.error_n))
    rows = rows[:: max(1, len(rows) // MAX_POINTS)]
    return pairs.columns["grf_n"][rows], pairs.error_n[rows]
