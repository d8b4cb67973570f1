"""Markdown report of the benchmark: figures, coverage, error budget, goals, failures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from studies.benchmark.draws import BATCH_FRAMES, LAGS_MS
from studies.benchmark.figures import (
    COVERAGE_GOAL_DRAWS,
    COVERAGE_TITLES,
    Goal,
    ModelSetFigures,
    Quantiles,
    SceneFigures,
    compare_with_goals,
)
from studies.benchmark.run import BenchmarkResult

EMULATED = (
    "Errors here are those of an emulated foot; the paper's (GRF within 1 N, COP within 4 mm) are "
    "those of a real one."
)

ERROR_FIGURES = (
    ("GRF mean abs N", "grf_mae_n", 1.0, 3),
    ("GRF RMS N", "grf_rms_n", 1.0, 3),
    ("GRF peak N", "peak_error_n", 1.0, 3),
    ("GRF when published N", "grf_published_mae_n", 1.0, 3),
    ("COP mean mm", "cop_mean_m", 1e3, 2),
    ("COP 95th percentile mm", "cop_p95_m", 1e3, 2),
)
_TEXT_HEADS = {"model set", "mode", "of the full model set", "met"} | {
    *("scene", "condition", "figure", "model", "of", "reason")
}
"""Heads of text columns."""
ADDITIONAL_FIGURES = (
    ("in flight, mean N", "flight_mean_n", 1.0, 3),
    ("in flight, mean abs N", "flight_mae_n", 1.0, 3),
    ("bias N", "grf_bias_n", 1.0, 3),
    ("impulse N s", "impulse_error_ns", 1.0, 3),
    ("sigma in mid-stance N", "grf_sigma_mid_stance_n", 1.0, 3),
    ("COP not stated %", "cop_masked_share", 100.0, 1),
    ("saturated frames", "saturated_frames", 1.0, 0),
    ("after saturation, mean abs N", "after_saturation_mae_n", 1.0, 3),
)


def format_benchmark_report(bench: BenchmarkResult) -> str:
    """Format the report of a benchmark."""
    o = bench.options
    lines = [
        "# Speed against error",
        "",
        f"{bench.software}, {bench.run_at}, on {bench.machine}.",
        "",
        f"Each error is the median over draws of tiles, calibration and noise ({o.draws} of each "
        "scene), in brackets its 5 to 95 % range over them; signs are dropped. Coverage is pooled "
        f"over the frames of all draws. Times are CPU time, medians of {o.repetitions} repetitions "
        f"with their 5 to 95 % range: live {o.live_frames} frames in batches of "
        f"{BATCH_FRAMES['live']}, offline {o.offline_frames} frames in chunks of "
        f"{BATCH_FRAMES['offline']}; the estimate alone, nothing read or written. "
        f"The look-ahead of live estimates is {LAGS_MS['live']:g} ms, "
        f"of offline ones {LAGS_MS['offline']:g} ms.",
        "",
        EMULATED,
    ]
    overrides = {"repeatability": o.repeatability, "noise correlated over ms": o.correlated_ms}
    named = ", ".join(f"{name} {value:g}" for name, value in overrides.items() if value is not None)
    if named:
        lines += ["", f"The emulation differs from that of the scenes: {named}."]
    for figures in bench.scenes:
        lines += ["", *_format_scene(figures)]
    return "\n".join(lines) + "\n"


def _format_scene(figures: SceneFigures) -> list[str]:
    lines = [
        f"## {figures.scene}",
        "",
        f"{figures.tile_count} tiles at {figures.rate_hz:.0f} frames/s, "
        f"{format_draw_count(figures.draw_count)} of {figures.frames.median:.0f} frames. "
        f"Its full model set: {', '.join(figures.default_model_set.models)}.",
    ]
    if figures.absent_models:
        lines += ["", f"Models of the scene that do not exist: {', '.join(figures.absent_models)}."]
    if figures.assumed_scale:
        lines += [
            "",
            "The scale of its calibration is assumed, so forces in newtons are unreliable.",
        ]
    if figures.failures:
        lines += ["", f"Not measured, {len(figures.failures)}:", ""]
        lines += [f"- {failure.what}: {failure.why}" for failure in figures.failures]
    for title, part in (
        ("Error and time", _format_errors(figures)),
        ("Further figures", _format_additional_figures(figures)),
        ("Covered by the 95 % interval", _format_coverage(figures)),
        ("Error budget", _format_budget(figures)),
        ("Goals", _format_goals(compare_with_goals(figures), figures.draw_count)),
    ):
        lines += ["", f"### {title}", "", *part]
    return lines


def _format_errors(figures: SceneFigures) -> list[str]:
    head = ("look-ahead ms", "ns per frame", *(title for title, *_ in ERROR_FIGURES))
    rows = [
        (
            *names,
            f"{m.lag_ms:g}",
            format_quantiles(m.ns_per_frame, 1.0, 0),
            *_cells(m, ERROR_FIGURES),
        )
        for names, m in _rows(figures)
    ]
    return format_table(("model set", "mode", *head), rows)


def _format_additional_figures(figures: SceneFigures) -> list[str]:
    rows = [(*names, *_cells(m, ADDITIONAL_FIGURES)) for names, m in _rows(figures)]
    return format_table(("model set", "mode", *(title for title, *_ in ADDITIONAL_FIGURES)), rows)


def _format_coverage(figures: SceneFigures) -> list[str]:
    rows = []
    for names, m in _rows(figures):
        shares = [m.coverage[name].share for name in COVERAGE_TITLES]
        rows.append((*names, *("-" if math.isnan(s) else f"{100 * s:.1f} %" for s in shares)))
    default = figures.figures_by_mode_and_label["offline", figures.default_model_set.label].coverage
    counts = ", ".join(f"{title} {default[name].frames}" for name, title in COVERAGE_TITLES.items())
    return [
        *format_table(("model set", "mode", *COVERAGE_TITLES.values()), rows),
        "",
        f"Frames of the full model set offline: {counts}.",
    ]


def _format_budget(figures: SceneFigures) -> list[str]:
    """Format the error budget: the increase of the error without each model."""
    rows = []
    for model_set in figures.model_sets:
        if model_set.missing_model is None and model_set.extra_model is None:
            continue
        row = [
            f"without {model_set.missing_model}"
            if model_set.missing_model
            else f"with {model_set.extra_model}, too"
        ]
        for mode in LAGS_MS:
            more = figures.figures_by_mode_and_label[mode, model_set.label].beyond_whole
            row += [
                format_quantiles(more["grf_mae_n"], 1.0, 3, sign="+"),
                format_quantiles(more["cop_p95_m"], 1e3, 2, sign="+"),
            ]
        rows.append(row)
    if not rows:
        if len(figures.model_sets) == 1 and len(figures.model_sets[0].models) > 1:
            return ["Not measured: only the full model set was estimated."]
        return ["No model of this set can be left out."]
    head = [f"{q}, {mode}" for mode in LAGS_MS for q in ("GRF mean abs N", "COP p95 mm")]
    text = (
        "Increase of the error without each model, or with one more, over the full model set: "
        "median of the differences by draw, and their range."
    )
    return [text, "", *format_table(("model set", *head), rows)]


def _format_goals(goals: Sequence[Goal], draws: int) -> list[str]:
    rows = []
    for goal in goals:
        least = "" if goal.least is None else f"{goal.least:g} to "
        value = "-" if math.isnan(goal.value) else f"{goal.value:.3g}"
        requested = f"{least}{goal.most:g}" if least else f"at most {goal.most:g}"
        rows.append((goal.figure, goal.mode, value, requested, "yes" if goal.is_met else "NO"))
    lines = format_table(("of the full model set", "mode", "measured", "goal", "met"), rows)
    if draws < COVERAGE_GOAL_DRAWS:
        lines += ["", f"The coverage goals are for {COVERAGE_GOAL_DRAWS} draws or more."]
    return lines


def _rows(figures: SceneFigures) -> list[tuple[tuple[str, str], ModelSetFigures]]:
    return [
        ((f"**{model_set.label}**" if model_set.is_full_set else model_set.label, mode), measured)
        for model_set in figures.model_sets
        for mode in LAGS_MS
        for measured in (figures.figures_by_mode_and_label[mode, model_set.label],)
    ]


def _cells(m: ModelSetFigures, columns: Sequence[tuple[str, str, float, int]]) -> list[str]:
    return [format_quantiles(m.figures[name], scale, digits) for _, name, scale, digits in columns]


def format_quantiles(spread: Quantiles, scale: float, digits: int, *, sign: str = "") -> str:
    """Format median and range in one cell; `sign` "+" also shows positive signs."""
    if not spread.n:
        return "-"
    low, median, high = (
        f"{scale * v:{sign}.{digits}f}" for v in (spread.p5, spread.median, spread.p95)
    )
    return f"{median} ({low} to {high})"


def format_draw_count(n: int) -> str:
    """Format a number of draws."""
    return "1 draw" if n == 1 else f"{n} draws"


def format_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format a Markdown table: text left-aligned, figures right-aligned."""
    rule = ["---" if title in _TEXT_HEADS else "--:" for title in head]
    return [f"| {' | '.join(cells)} |" for cells in (head, rule, *rows)]
