"""Report of a comparison: Markdown, and a plot of GRF, tiles, COP, and error over force."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from devices.arrays import Bools, Floats
from devices.errors import escape_control_chars
from service.estimation.records import SIGMAS_95
from service.offline.accuracy import PHASES
from service.offline.compare.alignment import ClockLag, ReferenceAlignment
from service.offline.compare.block_covariance import UncertainValue
from service.offline.compare.error_figures import ComparisonErrors
from service.offline.compare.paired_frames import PairedFrames, TrialMean
from service.offline.figure_output import create_figure, render_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes


FIGURE_TITLES: Mapping[str, str] = {
    "grf_frames": "frames under load that are judged",
    "grf_bias_n": "GRF, mean error, N",
    "grf_mae_n": "GRF, mean absolute error, N",
    "grf_rmse_n": "GRF, root mean square error, N",
    "grf_r2": "GRF, R²",
    "grf_coverage_95": "GRF, part within the 95 % interval",
    "grf_lag_n": "of the error, what the lag's uncertainty may make, N",
    "stances": "stances compared",
    "peak_bias_n": "peak, mean error, N",
    "peak_mae_n": "peak, mean absolute error, N",
    "impulse_bias_n_s": "impulse, mean error, N s",
    "impulse_mae_n_s": "impulse, mean absolute error, N s",
    "contact_bias_s": "contact, mean error, s",
    "contact_mae_s": "contact, mean absolute error, s",
    "lift_off_bias_s": "lift-off, mean error, s",
    "lift_off_mae_s": "lift-off, mean absolute error, s",
    "cop_mean_m": "COP, mean distance, m",
    "cop_p95_m": "COP, 95th percentile of the distance, m",
    "cop_bias_x_m": "COP, mean error along x, m",
    "cop_bias_y_m": "COP, mean error along y, m",
    "cop_p95_about_mean_m": "COP, 95th percentile of the distance about the mean error, m",
    "cop_coverage_x_95": "COP, part within the 95 % interval along x",
    "cop_coverage_y_95": "COP, part within the 95 % interval along y",
}
"""Title of every figure, by name."""
FIGURES_WITH_LOWER_LIMIT = frozenset(
    {
        *("grf_frames", "stances", "grf_r2", "grf_coverage_95"),
        *("cop_coverage_x_95", "cop_coverage_y_95"),
    }
)
"""Figures with a lower limit; the limits of all others are upper limits."""


def format_comparison_report(
    title: str,
    alignment: ReferenceAlignment,
    clock_lag: ClockLag | None,
    pairs: PairedFrames,
    errors: ComparisonErrors,
    trials_are: str,
    notes: Sequence[str],
) -> str:
    """Format the report of a comparison."""
    lines = [
        f"# {escape_control_chars(title)}",
        "",
        *(f"- {escape_control_chars(note)}" for note in notes),
        "",
    ]
    lines += _format_alignment(alignment, clock_lag, pairs)
    lines += _format_figures(errors, trials_are)
    lines += _format_trials(errors)
    lines += _format_phases(errors)
    return "\n".join(lines) + "\n"


def _format_alignment(
    alignment: ReferenceAlignment, by_clocks: ClockLag | None, pairs: PairedFrames
) -> Iterator[str]:
    removed = ", removed" if pairs.is_zero_removed else ", not removed"
    rows: list[tuple[str, UncertainValue | None, str]] = [
        (
            f"lag behind our clock at {alignment.mid_t_s:.2f} s, ms",
            alignment.lag_s.scale_by(1e3),
            "",
        ),
        ("drift against our clock, ppm", alignment.drift_ppm, ""),
        ("scale, newtons of ours for one of the reference", alignment.scale, ", never applied"),
        ("offset of the reference in flight, N", pairs.reference_zero_n, removed),
        ("offset by the fit, N", alignment.offset_n, ""),
    ]
    yield from (
        "## Alignment",
        "",
        "| | value | standard error of the fit | of our foot | 95 % interval |",
        "|---|--:|--:|--:|--:|",
    )
    for name, found, remark in rows:
        if found is None:
            yield f"| {name} | not known: no flight | - | - | - |"
            continue
        low, high = found.interval_95
        largest = ", mostly of our foot" if found.is_mostly_repeating else ""
        yield (
            f"| {name}{remark} | {found.value:.4f} | {found.sigma:.4f} | "
            f"{found.repeating_sigma:.4f} | {low:.4f} to {high:.4f}{largest} |"
        )
    if by_clocks is not None:
        low_s, high_s = (by_clocks.lag_s + side * by_clocks.error_bound_s for side in (-1.0, 1.0))
        yield (
            f"| the same lag by the clock tables, and its bounds, ms | {1e3 * by_clocks.lag_s:.4f} "
            f"| - | - | {1e3 * low_s:.4f} to {1e3 * high_s:.4f} |"
        )
    yield ""
    yield f"From {alignment.block_count} blocks of time. The reference bears load from"
    yield f"{pairs.contact_threshold_n:.2f} N over its zero. Intervals have both errors: of the"
    yield "fit, which is the scatter between blocks, and of our foot, which every stance repeats:"
    yield "no block shows it, and no longer recording averages it out."
    yield ""


def _format_figures(errors: ComparisonErrors, trials_are: str) -> Iterator[str]:
    count = len(errors.trials)
    yield from (
        "## Over trials",
        "",
        f"Trials: {trials_are}; {count} of them. Error is ours less the",
    )
    yield from (
        "reference.",
        "",
        "| figure | | mean | 95 % interval | trials |",
        "|---|---|--:|--:|--:|",
    )
    for name, what in FIGURE_TITLES.items():
        if (found := errors.figures.get(name)) is not None:
            cells = (
                f"`{name}`",
                what,
                format_number(found.mean),
                _format_interval(found),
                str(found.trials),
            )
            yield f"| {' | '.join(cells)} |"
    yield ""


def _format_trials(errors: ComparisonErrors) -> Iterator[str]:
    yield from ("## Trial by trial", "")
    yield (
        "| trial | GRF bias N | MAE N | RMSE N | R² | limits of agreement N | stances (left out) "
        "| COP p95 mm | COP frames: ours, reference, both |"
    )
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for trial in errors.trials:
        of, (low_n, high_n) = trial.figures, trial.limits_of_agreement_n
        cop = ", ".join(str(trial.cop_frames[name]) for name in ("ours", "reference", "both"))
        name = _escape_cell(trial.name)
        yield (
            f"| {name} | {format_number(of['grf_bias_n'])} | {format_number(of['grf_mae_n'])} | "
            f"{format_number(of['grf_rmse_n'])} | {format_number(of['grf_r2'])} | "
            f"{format_number(low_n)} to {format_number(high_n)} | "
            f"{len(trial.stances)} ({trial.stances_left_out}) | "
            f"{format_number(1e3 * of['cop_p95_m'])} | {cop} |"
        )
    yield ""


def _format_phases(errors: ComparisonErrors) -> Iterator[str]:
    yield from ("## By phase", "", "Phases are those of the reference's force.", "")
    yield from (
        "| trial | phase | frames | bias N | MAE N | covered % |",
        "|---|---|--:|--:|--:|--:|",
    )
    for trial in errors.trials:
        for name in PHASES:
            phase = trial.phases[name]
            share = math.nan if phase.covered is None else 100.0 * phase.covered.share
            yield (
                f"| {_escape_cell(trial.name)} | {name.replace('_', '-')} | "
                f"{phase.frames} | {format_number(phase.bias_n)} | {format_number(phase.mae_n)} | "
                f"{format_number(share)} |"
            )


def _escape_cell(name: str) -> str:
    """Return a name as a cell of a table in Markdown."""
    return escape_control_chars(name).replace("|", "\\|")


def _format_interval(found: TrialMean) -> str:
    if found.interval_95 is None:
        return "-"
    return f"{format_number(found.interval_95[0])} to {format_number(found.interval_95[1])}"


def format_number(value: float) -> str:
    """Format a number with four digits; NaN as a dash."""
    return "-" if math.isnan(value) else f"{value:.4g}"


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
        pairs: our n frames with the reference.
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
    reference_n = pairs.reference_n[rows]
    count = plot_tiles(over_time[2], t_s, force_n[rows], serials, reference_n, "reference")
    over_time[2].legend(fontsize=8, loc="upper right", ncols=max(1, (count + 2) // 2))
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
    plot_band(force, t_s, grf_n, half_n, OUR_COLOUR, "ours, 95 %")
    force.plot(t_s, grf_n, color=OUR_COLOUR, linewidth=1.2, label="ours")
    force.plot(
        t_s, pairs.reference_n[rows], "--", color=REFERENCE_COLOUR, linewidth=1.2, label="reference"
    )
    force.set_ylabel("GRF, N")
    force.legend(fontsize=8, loc="upper right", ncols=3)
    plot_band(error, t_s, np.zeros(len(t_s)), half_n, OUR_COLOUR)
    error.plot(t_s, pairs.error_n[rows], color="black", linewidth=0.8)
    error.set_ylabel("ours less\nreference, N")


def plot_band(
    axis: Axes, x: Floats, middle: Floats, half: Floats, colour: str, label: str | None = None
) -> None:
    """Plot a band of half the width on each side of its middle."""
    low, high = middle - half, middle + half
    axis.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0, label=label)


def plot_tiles(
    axis: Axes, t_s: Floats, force_n: Floats, serials: Sequence[str], reference_n: Floats, name: str
) -> int:
    """Plot the forces of tiles, one upon another, and a reference; return the number of tiles."""
    borne = [i for i in range(force_n.shape[1]) if np.isfinite(force_n[:, i]).any()]
    if borne:
        # Stacked tiles sum to the GRF; negative forces cannot be stacked.
        heights_n = np.maximum(np.nan_to_num(force_n[:, borne].T), 0.0)
        colours = [TILE_COLOURS[k % len(TILE_COLOURS)] for k in range(len(borne))]
        names = [serials[i] for i in borne]
        axis.stackplot(t_s, heights_n, labels=names, colors=colours, linewidth=0, alpha=0.85)
    axis.plot(t_s, reference_n, "--", color="black", linewidth=1.1, label=name)
    axis.set_ylabel("tiles, one upon\nanother, N")
    return len(borne)


def _plot_cop(place: Axes, error: Axes, pairs: PairedFrames, rows: Bools) -> None:
    t_s = pairs.t_s[rows]
    theirs_mm = (
        1e3 * np.where(pairs.reference_contact[:, None], pairs.reference_cop_m, np.nan)[rows]
    )
    stated = np.isfinite(theirs_mm).any()
    for k, (name, colour) in enumerate((("x", OUR_COLOUR), ("y", "#009E73"))):
        ours_mm = 1e3 * pairs.columns[f"cop_{name}_m"][rows]
        half_mm = 1e3 * SIGMAS_95 * pairs.columns[f"cop_sigma_{name}_m"][rows]
        plot_band(place, t_s, ours_mm, half_mm, colour)
        place.plot(t_s, ours_mm, color=colour, linewidth=1.2, label=f"ours, {name}")
        if stated:
            place.plot(t_s, theirs_mm[:, k], "--", color="black", linewidth=0.9 + 0.3 * k)
            off_mm = ours_mm - theirs_mm[:, k]
            error.plot(t_s, off_mm, color=colour, linewidth=0.9, label=name)
            plot_band(error, t_s, np.zeros(len(t_s)), half_mm, colour)
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
