"""Plot of time per frame against GRF error, by scene, with the Pareto front of each mode.

A panel has a half for each mode, because their times are two decades apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.offline.benchmark.draws import LAGS_MS
from service.offline.benchmark.figures import GRF_MAE_N, SceneFigures, Spread, pareto
from service.offline.benchmark.report import draws_text
from service.offline.benchmark.rungs import Rung
from service.offline.plots import DPI, new_figure, png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Two of Okabe and Ito's colours, and two shapes, for any colour vision and for black and white.
STYLES = {"live": ("#0072B2", "o"), "offline": ("#D55E00", "s")}
HALVES = ("offline", "live")
GREY = "#595959"
GOAL_DASHES = (0, (5, 4))


@dataclass(frozen=True)
class _Mark:
    rung: Rung
    ns: float
    error_n: Spread

    @property
    def name(self) -> str:
        if self.rung.is_built_up:
            return self.rung.label
        return f"++{self.rung.spare}" if self.rung.spare else f"\N{MINUS SIGN}{self.rung.lacks}"


def plot_bench(scenes: Sequence[SceneFigures]) -> bytes:
    """Draw the plot as a PNG.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = new_figure(9.0, 1.4 + 5.0 * len(scenes))
    panels = figure.subplots(len(scenes), 2, squeeze=False)
    to_label: list[tuple[Axes, str, float | None, list[_Mark]]] = []
    for figures, (left, right) in zip(scenes, panels, strict=True):
        for mode, axes in zip(HALVES, (left, right), strict=True):
            goal_n = GRF_MAE_N.get(figures.scene, {}).get(mode)
            to_label.append((axes, mode, goal_n, _half(axes, figures, mode, goal_n)))
        left.set_ylabel("GRF error, mean absolute, N")
        right.tick_params(axis="y", length=0, labelleft=False)
        right.spines["left"].set_visible(False)
        left.set_title(
            f"{figures.scene}: {figures.tiles} tiles, median of {draws_text(figures.draws)}",
            loc="left",
            fontsize=12,
            pad=22,
        )
    figure.suptitle("What the estimate of a frame costs, and how far its force is off", fontsize=14)
    _legend(figure)
    # Pixel positions are known only after the layout is done.
    figure.set_dpi(DPI)
    engine: Any = figure.get_layout_engine()
    engine.set(wspace=0.02, hspace=0.05)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for of_half in to_label:
        _label(*of_half)
    return png_of(figure)


def _half(axes: Axes, figures: SceneFigures, mode: str, goal_n: float | None) -> list[_Mark]:
    """Draw points, bars, front and goal of one mode."""
    colour, shape = STYLES[mode]
    marks = []
    for rung in figures.rungs:
        m = figures.measured[mode, rung.label]
        mark = _Mark(rung, m.ns_per_frame.median, m.figures["grf_mae_n"])
        if math.isfinite(mark.ns) and math.isfinite(mark.error_n.median):
            marks.append(mark)
    for mark in marks:
        error_n, is_default = mark.error_n, mark.rung.is_default
        axes.errorbar(
            *([mark.ns], [error_n.median]),
            yerr=[[error_n.median - error_n.p5], [error_n.p95 - error_n.median]],
            marker=shape,
            markersize=12 if is_default else 6.5,
            markerfacecolor=colour if mark.rung.is_built_up else "white",
            markeredgecolor="black" if is_default else colour,
            markeredgewidth=2.0 if is_default else 1.2,
            ecolor=colour,
            elinewidth=0.8,
            linestyle="none",
            zorder=4 if is_default else 3,
        )
    points = [(mark.ns, mark.error_n.median) for mark in marks]
    front = [points[i] for i in pareto(points)]
    axes.plot([x for x, _ in front], [y for _, y in front], color=colour, linewidth=1.5, zorder=2)
    if goal_n is not None:
        axes.axhline(goal_n, color=GREY, linewidth=1.0, linestyle=GOAL_DASHES, zorder=1)
    _scales(axes, figures, [x for x, _ in points])
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


def _scales(axes: Axes, figures: SceneFigures, times_ns: Sequence[float]) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set_xscale("log")
    if times_ns:
        middle = math.sqrt(min(times_ns) * max(times_ns))
        reach = 2.2 * math.sqrt(max(times_ns) / min(times_ns))
        axes.set_xlim(middle / reach, middle * reach)
    highs = [m.figures["grf_mae_n"].p95 for m in figures.measured.values()]
    goals_n = GRF_MAE_N.get(figures.scene, {}).values()
    known = [high for high in highs if math.isfinite(high)] + list(goals_n)
    axes.set_ylim(0.0, 1.08 * max(known, default=1.0))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(time_text)
    axes.tick_params(labelsize=9)
    axes.set_xlabel("CPU time per frame")
    axes.grid(visible=True, color="#E6E6E6")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def time_text(ns: float, _: object = None) -> str:
    """Format a time in ns with a suitable unit."""
    for unit, size in (("ms", 1e6), ("µs", 1e3)):
        if ns >= size:
            return f"{ns / size:g} {unit}"
    return f"{ns:g} ns"


def _legend(figure: Figure) -> None:
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


def _label(axes: Axes, mode: str, goal_n: float | None, marks: Sequence[_Mark]) -> None:
    """Place every label in free space, as near to its point as possible."""
    from textalloc import allocate

    if not marks:
        return
    # The full model set and the built-up ones first: they get the best places.
    marks = sorted(marks, key=lambda m: (not m.rung.is_default, not m.rung.is_built_up))
    ns, errors_n = [m.ns for m in marks], [m.error_n.median for m in marks]
    front = pareto(list(zip(ns, errors_n, strict=True)))
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
        textsize=[9.5 if m.rung.is_default else 8.5 for m in marks],
        fontweight=["bold" if m.rung.is_default else "normal" for m in marks],
        textcolor=["black" if m.rung.is_default else colour for m in marks],
        linecolor=colour,
        linewidth=0.6,
    )
