"""Markdown report of a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from devices.errors import escape_control_chars
from service.offline.accuracy import PHASES
from service.offline.compare.alignment import Alignment, ClockLag
from service.offline.compare.block_covariance import UncertainValue
from service.offline.compare.error_figures import ComparisonErrors
from service.offline.compare.paired_frames import PairedFrames, TrialMean

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
    alignment: Alignment,
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
    alignment: Alignment, by_clocks: ClockLag | None, pairs: PairedFrames
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
        "| | value | standard error | of our foot | 95 % interval |",
        "|---|--:|--:|--:|--:|",
    )
    for name, found, remark in rows:
        if found is None:
            yield f"| {name} | not known: no flight | - | - | - |"
            continue
        low, high = found.interval_95
        yield (
            f"| {name}{remark} | {found.value:.4f} | {found.sigma:.4f} | "
            f"{found.repeating_sigma:.4f} | {low:.4f} to {high:.4f} |"
        )
    if by_clocks is not None:
        low_s, high_s = (by_clocks.lag_s + side * by_clocks.error_bound_s for side in (-1.0, 1.0))
        yield (
            f"| the same lag by the clock tables, and its bounds, ms | {1e3 * by_clocks.lag_s:.4f} "
            f"| - | - | {1e3 * low_s:.4f} to {1e3 * high_s:.4f} |"
        )
    yield ""
    yield f"From {alignment.block_count} blocks of time. The reference bears load from"
    yield f"{pairs.contact_threshold_n:.2f} N over its zero."
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
