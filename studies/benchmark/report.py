"""Report of the benchmark: Markdown, and a plot of time per frame against GRF error.

Figures, coverage, error budget, goals and failures are tables. The plot has a panel for each scene
with the Pareto front of each mode, in halves, because the modes' times are two decades apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.offline.figure_output import DPI, create_figure, render_png
from studies.benchmark.draws import BATCH_FRAMES, LAGS_MS, ComparedModelSet
from studies.benchmark.figures import (
    COVERAGE_GOAL_DRAWS,
    COVERAGE_TITLES,
    GRF_MAE_GOALS_N,
    Goal,
    ModelSetFigures,
    Quantiles,
    SceneFigures,
    compare_with_goals,
    find_pareto_front,
)
from studies.benchmark.run import BenchmarkResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


# Two of Okabe and Ito's colours, and two shapes, for any colour vision and for black and white.
STYLES = {"live": ("#0072B2", "o"), "offline": ("#D55E00", "s")}
HALVES = ("offline", "live")
GREY = "#595959"
GOAL_DASHES = (0, (5, 4))


@dataclass(frozen=True)
class _Point:
    model_set: ComparedModelSet
    ns: float
    error_n: Quantiles

    @property
    def name(self) -> str:
        if self.model_set.is_built_up:
            return self.model_set.label
        return (
            f"++{self.model_set.extra_model}"
            if self.model_set.extra_model
            else f"\N{MINUS SIGN}{self.model_set.missing_model}"
        )


def plot_benchmark(scenes: Sequence[SceneFigures]) -> bytes:
    """Draw the plot as a PNG.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = create_figure(9.0, 1.4 + 5.0 * len(scenes))
    panels = figure.subplots(len(scenes), 2, squeeze=False)
    to_label: list[tuple[Axes, str, float | None, list[_Point]]] = []
    for figures, (left, right) in zip(scenes, panels, strict=True):
        for mode, axes in zip(HALVES, (left, right), strict=True):
            goal_n = GRF_MAE_GOALS_N.get(figures.scene, {}).get(mode)
            to_label.append((axes, mode, goal_n, _plot_mode(axes, figures, mode, goal_n)))
        left.set_ylabel("GRF error, mean absolute, N")
        right.tick_params(axis="y", length=0, labelleft=False)
        right.spines["left"].set_visible(False)
        left.set_title(
            f"{figures.scene}: {figures.tile_count} tiles, "
            f"median of {format_draw_count(figures.draw_count)}",
            loc="left",
            fontsize=12,
            pad=22,
        )
    figure.suptitle("What the estimate of a frame costs, and how far its force is off", fontsize=14)
    _draw_legend(figure)
    # Pixel positions are known only after the layout is done.
    figure.set_dpi(DPI)
    engine: Any = figure.get_layout_engine()
    engine.set(wspace=0.02, hspace=0.05)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for of_half in to_label:
        _place_labels(*of_half)
    return render_png(figure)


def _plot_mode(axes: Axes, figures: SceneFigures, mode: str, goal_n: float | None) -> list[_Point]:
    """Draw points, bars, front and goal of one mode."""
    colour, shape = STYLES[mode]
    marks = []
    for model_set in figures.model_sets:
        m = figures.figures_by_mode_and_label[mode, model_set.label]
        mark = _Point(model_set, m.ns_per_frame.median, m.figures["grf_mae_n"])
        if math.isfinite(mark.ns) and math.isfinite(mark.error_n.median):
            marks.append(mark)
    for mark in marks:
        error_n, is_full_set = mark.error_n, mark.model_set.is_full_set
        axes.errorbar(
            *([mark.ns], [error_n.median]),
            yerr=[[error_n.median - error_n.p5], [error_n.p95 - error_n.median]],
            marker=shape,
            markersize=12 if is_full_set else 6.5,
            markerfacecolor=colour if mark.model_set.is_built_up else "white",
            markeredgecolor="black" if is_full_set else colour,
            markeredgewidth=2.0 if is_full_set else 1.2,
            ecolor=colour,
            elinewidth=0.8,
            linestyle="none",
            zorder=4 if is_full_set else 3,
        )
    points = [(mark.ns, mark.error_n.median) for mark in marks]
    front = [points[i] for i in find_pareto_front(points)]
    axes.plot([x for x, _ in front], [y for _, y in front], color=colour, linewidth=1.5, zorder=2)
    if goal_n is not None:
        axes.axhline(goal_n, color=GREY, linewidth=1.0, linestyle=GOAL_DASHES, zorder=1)
    _set_scales(axes, figures, [x for x, _ in points])
    axes.text(
        *(0.5, 1.015),
        f"{mode}, {LAGS_MS[mode]:g} ms look-ahead",
        transform=axes.transAxes,
        ha="center",
        color=colour,
        fontsize=10,
        fontweight="bold",
    )
    return marks


def _set_scales(axes: Axes, figures: SceneFigures, times_ns: Sequence[float]) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set_xscale("log")
    if times_ns:
        middle = math.sqrt(min(times_ns) * max(times_ns))
        reach = 2.2 * math.sqrt(max(times_ns) / min(times_ns))
        axes.set_xlim(middle / reach, middle * reach)
    highs = [m.figures["grf_mae_n"].p95 for m in figures.figures_by_mode_and_label.values()]
    goals_n = GRF_MAE_GOALS_N.get(figures.scene, {}).values()
    known = [high for high in highs if math.isfinite(high)] + list(goals_n)
    axes.set_ylim(0.0, 1.08 * max(known, default=1.0))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(format_time)
    axes.tick_params(labelsize=9)
    axes.set_xlabel("CPU time per frame")
    axes.grid(visible=True, color="#E6E6E6")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def format_time(ns: float, _: object = None) -> str:
    """Format a time in ns with a suitable unit."""
    for unit, size in (("ms", 1e6), ("µs", 1e3)):
        if ns >= size:
            return f"{ns / size:g} {unit}"
    return f"{ns:g} ns"


def _draw_legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    def mark(face: str, edge: str, width: float, size: float, label: str) -> Line2D:
        return Line2D(
            *([], []),
            marker="o",
            markerfacecolor=face,
            markeredgecolor=edge,
            markeredgewidth=width,
            markersize=size,
            linestyle="none",
            label=label,
        )

    figure.legend(
        handles=[
            mark("#BFBFBF", "black", 2.0, 11, "the scene's full model set"),
            mark(GREY, GREY, 1.2, 6, "built up, one model more each"),
            mark(
                "white",
                GREY,
                1.2,
                6,
                "full model set without (\N{MINUS SIGN}) or with one more (++) model",
            ),
            Line2D([], [], color=GREY, linewidth=1.5, label="Pareto front"),
            Line2D([], [], color=GREY, linewidth=1.0, linestyle=GOAL_DASHES, label="goal"),
        ],
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
        title="Emulated feet. Bars: 5 to 95 % of the draws of tiles, calibration and noise.",
        title_fontsize=9,
    )


def _place_labels(axes: Axes, mode: str, goal_n: float | None, marks: Sequence[_Point]) -> None:
    """Place every label in free space, as near to its point as possible."""
    from textalloc import allocate

    if not marks:
        return
    # The full model set and the built-up ones first: they get the best places.
    marks = sorted(marks, key=lambda m: (not m.model_set.is_full_set, not m.model_set.is_built_up))
    ns, errors_n = [m.ns for m in marks], [m.error_n.median for m in marks]
    front = find_pareto_front(list(zip(ns, errors_n, strict=True)))
    bars = [([m.ns, m.ns], [m.error_n.p5, m.error_n.p95]) for m in marks]
    along = ([ns[i] for i in front], [errors_n[i] for i in front])
    goal = (list(axes.get_xlim()), [goal_n or 0.0] * 2)
    x_lines, y_lines = zip(*bars, along, goal, strict=True)
    colour, _ = STYLES[mode]
    allocate(
        *(axes, ns, errors_n, [m.name for m in marks]),
        x_scatter=ns,
        y_scatter=errors_n,
        x_lines=list(x_lines),
        y_lines=list(y_lines),
        min_distance=0.018,
        textsize=[9.5 if m.model_set.is_full_set else 8.5 for m in marks],
        fontweight=["bold" if m.model_set.is_full_set else "normal" for m in marks],
        textcolor=["black" if m.model_set.is_full_set else colour for m in marks],
        linecolor=colour,
        linewidth=0.6,
    )
