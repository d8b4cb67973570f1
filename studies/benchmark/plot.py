"""Plot of time per frame against GRF error, by scene, with the Pareto front of each mode.

A panel has a half for each mode, because their times are two decades apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.offline.figure_output import DPI, create_figure, render_png
from studies.benchmark.draws import LAGS_MS, ComparedModelSet
from studies.benchmark.figures import (
    GRF_MAE_GOALS_N,
    Quantiles,
    SceneFigures,
    find_pareto_front,
)
from studies.benchmark.report import format_draw_count

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
