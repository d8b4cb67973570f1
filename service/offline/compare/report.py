"""Markdown report of a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from devices.words import printable
from service.offline.accuracy import PHASES
from service.offline.compare.align import Alignment
from service.offline.compare.blocks import Estimate
from service.offline.compare.clocks import ClockLag
from service.offline.compare.errors import Errors
from service.offline.compare.pairs import Pairs
from service.offline.compare.trials import OverTrials

FIGURES: Mapping[str, str] = {
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
AT_LEAST = frozenset(
    {
        *("grf_frames", "stances", "grf_r2", "grf_coverage_95"),
        *("cop_coverage_x_95", "cop_coverage_y_95"),
    }
)
"""Figures with a lower limit; the limits of all others are upper limits."""


def markdown(
    title: str,
    alignment: Alignment,
    by_clocks: ClockLag | None,
    pairs: Pairs,
    errors: Errors,
    trials_are: str,
    notes: Sequence[str],
) -> str:
    """Format the report of a comparison."""
    lines = [f"# {printable(title)}", "", *(f"- {printable(note)}" for note in notes), ""]
    lines += _alignment(alignment, by_clocks, pairs)
    lines += _figures(errors, trials_are)
    lines += _trials(errors)
    lines += _phases(errors)
    return "\n".join(lines) + "\n"


def _alignment(alignment: Alignment, by_clocks: ClockLag | None, pairs: Pairs) -> Iterator[str]:
    removed = ", removed" if pairs.removed else ", not removed"
    rows: list[tuple[str, Estimate | None, str]] = [
        (f"lag behind our clock at {alignment.at_s:.2f} s, ms", alignment.lag_s.times(1e3), ""),
        ("drift against our clock, ppm", alignment.drift_ppm, ""),
        ("scale, newtons of ours for one of the reference", alignment.scale, ", never applied"),
        ("offset of the reference in flight, N", pairs.zero_n, removed),
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
            f"| {name}{remark} | {found.value:.4f} | {found.sigma:.4f} | {found.own:.4f} | "
            f"{low:.4f} to {high:.4f} |"
        )
    if by_clocks is not None:
        low_s, high_s = (by_clocks.lag_s + side * by_clocks.within_s for side in (-1.0, 1.0))
        yield (
            f"| the same lag by the clock tables, and its bounds, ms | {1e3 * by_clocks.lag_s:.4f} "
            f"| - | - | {1e3 * low_s:.4f} to {1e3 * high_s:.4f} |"
        )
    yield ""
    yield f"From {alignment.blocks} blocks of time. The reference bears load from"
    yield f"{pairs.contact_n:.2f} N over its zero."
    yield ""


def _figures(errors: Errors, trials_are: str) -> Iterator[str]:
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
    for name, what in FIGURES.items():
        if (found := errors.figures.get(name)) is not None:
            cells = (f"`{name}`", what, number(found.mean), _interval(found), str(found.trials))
            yield f"| {' | '.join(cells)} |"
    yield ""


def _trials(errors: Errors) -> Iterator[str]:
    yield from ("## Trial by trial", "")
    yield (
        "| trial | GRF bias N | MAE N | RMSE N | R² | limits of agreement N | stances (left out) "
        "| COP p95 mm | COP frames: ours, reference, both |"
    )
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for trial in errors.trials:
        of, (low_n, high_n) = trial.figures, trial.limits_of_agreement_n
        cop = ", ".join(str(trial.cop_frames[name]) for name in ("ours", "reference", "both"))
        name = _cell(trial.name)
        yield (
            f"| {name} | {number(of['grf_bias_n'])} | {number(of['grf_mae_n'])} | "
            f"{number(of['grf_rmse_n'])} | {number(of['grf_r2'])} | {number(low_n)} to "
            f"{number(high_n)} | {len(trial.stances)} ({trial.stances_left_out}) | "
            f"{number(1e3 * of['cop_p95_m'])} | {cop} |"
        )
    yield ""


def _phases(errors: Errors) -> Iterator[str]:
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
                f"| {_cell(trial.name)} | {name.replace('_', '-')} | "
                f"{phase.frames} | {number(phase.bias_n)} | {number(phase.mae_n)} | "
                f"{number(share)} |"
            )


def _cell(name: str) -> str:
    """Return a name as a cell of a table in Markdown."""
    return printable(name).replace("|", "\\|")


def _interval(found: OverTrials) -> str:
    if found.interval_95 is None:
        return "-"
    return f"{number(found.interval_95[0])} to {number(found.interval_95[1])}"


def number(value: float) -> str:
    """Format a number with four digits; NaN as a dash."""
    return "-" if math.isnan(value) else f"{value:.4g}"
