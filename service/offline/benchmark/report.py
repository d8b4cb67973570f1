"""Markdown report of the benchmark: figures, coverage, error budget, goals, failures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from service.offline.benchmark.draws import BATCH, LAGS_MS
from service.offline.benchmark.figures import (
    COVERAGE_DRAWS,
    COVERED,
    Goal,
    Measured,
    SceneFigures,
    Spread,
    goals_of,
)
from service.offline.benchmark.run import Bench

EMULATED = (
    "Errors here are those of an emulated foot; the paper's (GRF within 1 N, COP within 4 mm) are "
    "those of a real one."
)

ERRORS = (
    ("GRF mean abs N", "grf_mae_n", 1.0, 3),
    ("GRF RMS N", "grf_rms_n", 1.0, 3),
    ("GRF peak N", "peak_error_n", 1.0, 3),
    ("GRF when published N", "grf_published_mae_n", 1.0, 3),
    ("COP mean mm", "cop_mean_m", 1e3, 2),
    ("COP 95th percentile mm", "cop_p95_m", 1e3, 2),
)
_WORDS = {"model set", "mode", "of the full model set", "met"} | {
    *("scene", "condition", "figure", "model", "of", "reason")
}
"""Heads of text columns."""
BESIDE = (
    ("in flight, mean N", "flight_mean_n", 1.0, 3),
    ("in flight, mean abs N", "flight_mae_n", 1.0, 3),
    ("bias N", "grf_bias_n", 1.0, 3),
    ("impulse N s", "impulse_error_ns", 1.0, 3),
    ("sigma in mid-stance N", "grf_sigma_mid_stance_n", 1.0, 3),
    ("COP not stated %", "cop_masked_share", 100.0, 1),
    ("saturated frames", "saturated_frames", 1.0, 0),
    ("after saturation, mean abs N", "after_saturation_mae_n", 1.0, 3),
)


def markdown(bench: Bench) -> str:
    """Format the report of a benchmark."""
    o = bench.options
    lines = [
        "# Speed against error",
        "",
        f"{bench.software}, {bench.made}, on {bench.machine}.",
        "",
        f"Each error is the median over draws of tiles, calibration and noise ({o.draws} of each "
        "scene), in brackets its 5 to 95 % range over them; signs are dropped. Coverage is pooled "
        f"over the frames of all draws. Times are CPU time, medians of {o.repetitions} repetitions "
        f"with their 5 to 95 % range: live {o.live_frames} frames in batches of {BATCH['live']}, "
        f"offline {o.offline_frames} frames in chunks of {BATCH['offline']}; the estimate alone, "
        "nothing read or written. The look-ahead of live estimates is "
        f"{LAGS_MS['live']:g} ms, of offline ones {LAGS_MS['offline']:g} ms.",
        "",
        EMULATED,
    ]
    overrides = {"repeatability": o.repeatability, "noise correlated over ms": o.correlated_ms}
    named = ", ".join(f"{name} {value:g}" for name, value in overrides.items() if value is not None)
    if named:
        lines += ["", f"The emulation differs from that of the scenes: {named}."]
    for figures in bench.scenes:
        lines += ["", *_scene(figures)]
    return "\n".join(lines) + "\n"


def _scene(figures: SceneFigures) -> list[str]:
    lines = [
        f"## {figures.scene}",
        "",
        f"{figures.tiles} tiles at {figures.rate_hz:.0f} frames/s, {draws_text(figures.draws)} "
        f"of {figures.frames.median:.0f} frames. Its full model set: "
        f"{', '.join(figures.default.models)}.",
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
        ("Error and time", _errors(figures)),
        ("Further figures", _beside(figures)),
        ("Covered by the 95 % interval", _coverage(figures)),
        ("Error budget", _budget(figures)),
        ("Goals", _goals(goals_of(figures), figures.draws)),
    ):
        lines += ["", f"### {title}", "", *part]
    return lines


def _errors(figures: SceneFigures) -> list[str]:
    head = ("look-ahead ms", "ns per frame", *(title for title, *_ in ERRORS))
    rows = [
        (*names, f"{m.lag_ms:g}", spread_text(m.ns_per_frame, 1.0, 0), *_cells(m, ERRORS))
        for names, m in _rows(figures)
    ]
    return table(("model set", "mode", *head), rows)


def _beside(figures: SceneFigures) -> list[str]:
    rows = [(*names, *_cells(m, BESIDE)) for names, m in _rows(figures)]
    return table(("model set", "mode", *(title for title, *_ in BESIDE)), rows)


def _coverage(figures: SceneFigures) -> list[str]:
    rows = []
    for names, m in _rows(figures):
        shares = [m.coverage[name].share for name in COVERED]
        rows.append((*names, *("-" if math.isnan(s) else f"{100 * s:.1f} %" for s in shares)))
    default = figures.measured["offline", figures.default.label].coverage
    counts = ", ".join(f"{title} {default[name].frames}" for name, title in COVERED.items())
    return [
        *table(("model set", "mode", *COVERED.values()), rows),
        "",
        f"Frames of the full model set offline: {counts}.",
    ]


def _budget(figures: SceneFigures) -> list[str]:
    """Format the error budget: the increase of the error without each model."""
    rows = []
    for rung in figures.rungs:
        if rung.lacks is None and rung.spare is None:
            continue
        row = [f"without {rung.lacks}" if rung.lacks else f"with {rung.spare}, too"]
        for mode in LAGS_MS:
            more = figures.measured[mode, rung.label].beyond_whole
            row += [
                spread_text(more["grf_mae_n"], 1.0, 3, sign="+"),
                spread_text(more["cop_p95_m"], 1e3, 2, sign="+"),
            ]
        rows.append(row)
    if not rows:
        if len(figures.rungs) == 1 and len(figures.rungs[0].models) > 1:
            return ["Not measured: only the full model set was estimated."]
        return ["No model of this set can be left out."]
    head = [f"{q}, {mode}" for mode in LAGS_MS for q in ("GRF mean abs N", "COP p95 mm")]
    text = (
        "Increase of the error without each model, or with one more, over the full model set: "
        "median of the differences by draw, and their range."
    )
    return [text, "", *table(("model set", *head), rows)]


def _goals(goals: Sequence[Goal], draws: int) -> list[str]:
    rows = []
    for goal in goals:
        least = "" if goal.least is None else f"{goal.least:g} to "
        value = "-" if math.isnan(goal.value) else f"{goal.value:.3g}"
        asked = f"{least}{goal.most:g}" if least else f"at most {goal.most:g}"
        rows.append((goal.figure, goal.mode, value, asked, "yes" if goal.met else "NO"))
    lines = table(("of the full model set", "mode", "measured", "goal", "met"), rows)
    if draws < COVERAGE_DRAWS:
        lines += ["", f"The coverage goals are for {COVERAGE_DRAWS} draws or more."]
    return lines


def _rows(figures: SceneFigures) -> list[tuple[tuple[str, str], Measured]]:
    return [
        ((f"**{rung.label}**" if rung.is_default else rung.label, mode), measured)
        for rung in figures.rungs
        for mode in LAGS_MS
        for measured in (figures.measured[mode, rung.label],)
    ]


def _cells(m: Measured, columns: Sequence[tuple[str, str, float, int]]) -> list[str]:
    return [spread_text(m.figures[name], scale, digits) for _, name, scale, digits in columns]


def spread_text(spread: Spread, scale: float, digits: int, *, sign: str = "") -> str:
    """Format median and range in one cell; `sign` "+" also shows positive signs."""
    if not spread.n:
        return "-"
    low, median, high = (
        f"{scale * v:{sign}.{digits}f}" for v in (spread.p5, spread.median, spread.p95)
    )
    return f"{median} ({low} to {high})"


def draws_text(n: int) -> str:
    """Format a number of draws."""
    return "1 draw" if n == 1 else f"{n} draws"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format a Markdown table: text left-aligned, figures right-aligned."""
    rule = ["---" if title in _WORDS else "--:" for title in head]
    return [f"| {' | '.join(cells)} |" for cells in (head, rule, *rows)]
