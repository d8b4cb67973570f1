"""Time per frame against GRF error, one panel per scene, with the Pareto front of each mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from service.benchmark.draws import LAGS_MS
from service.benchmark.figures import SceneFigures, pareto
from service.benchmark.goals import GRF_MAE_N
from service.plots import DPI, new_figure, png_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Two of Okabe and Ito's colours, and two shapes, so that neither colour nor print is needed.
STYLES = {"live": ("#0072B2", "o"), "offline": ("#D55E00", "s")}
GREY = "#595959"

Box = tuple[float, float, float, float]
"""Left, bottom, right, top in pixels."""


def plot_bench(scenes: Sequence[SceneFigures]) -> bytes:
    """The plot as a PNG.

    Raises:
        UsageError: matplotlib is not installed.
    """
    figure = new_figure(1.2 + 6.4 * len(scenes), 6.2)
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    marks = [_panel(axes, figures) for axes, figures in zip(panels, scenes, strict=True)]
    panels[0].set_ylabel("GRF error, mean absolute, N")
    figure.suptitle("What a frame's estimate costs, and how far its force is off", fontsize=13)
    _legend(figure, panels[0])
    figure.text(
        *(0.01, 0.008),
        "Emulated feet. Median over draws of tiles, calibration and noise; bars: 5 to 95 %.",
        fontsize=8.5,
        color=GREY,
    )
    # Places are known in pixels only after everything else has found its own.
    figure.set_dpi(DPI)
    figure.get_layout_engine().set(rect=(0.0, 0.04, 1.0, 0.96))
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes, marked in zip(panels, marks, strict=True):
        _label(axes, marked)
    return png_of(figure)


_Mark = tuple[float, float, str, str, bool]
"""Where, what to call it, in which colour, and whether it is the scene's own."""


def _panel(axes: Axes, figures: SceneFigures) -> list[_Mark]:
    marks: list[_Mark] = []
    for mode in LAGS_MS:
        colour, shape = STYLES[mode]
        points = []
        for rung in figures.rungs:
            m = figures.measured[mode, rung.label]
            error_n = m.figures["grf_mae_n"]
            at = (m.ns_per_frame.median, error_n.median)
            points.append(at)
            if not all(map(math.isfinite, at)):
                continue
            axes.errorbar(
                *([at[0]], [at[1]]),
                yerr=[[error_n.median - error_n.low], [error_n.high - error_n.median]],
                marker=shape,
                markersize=11 if rung.is_default else 6,
                markerfacecolor=colour if rung.is_built_up else "white",
                markeredgecolor="black" if rung.is_default else colour,
                markeredgewidth=1.8 if rung.is_default else 1.2,
                ecolor=colour,
                elinewidth=0.8,
                alpha=1.0 if rung.is_built_up else 0.75,
                linestyle="none",
                zorder=4 if rung.is_default else 3,
            )
            marks.append((*at, rung.label, colour, rung.is_default))
        front = [points[i] for i in pareto(points)]
        axes.plot(
            [x for x, _ in front], [y for _, y in front], color=colour, linewidth=1.4, zorder=2
        )
        goal_n = GRF_MAE_N.get(figures.scene, {}).get(mode)
        if goal_n is not None:
            axes.axhline(goal_n, color=colour, linewidth=0.9, linestyle=(0, (5, 4)), zorder=1)
    axes.set_xscale("log")
    axes.set_ylim(bottom=0.0, top=_top_n(figures))
    axes.margins(x=0.22)
    axes.xaxis.set_major_formatter(_time_text)
    axes.xaxis.set_minor_formatter(_time_text_between)
    axes.tick_params(axis="x", which="both", labelsize=9)
    axes.set_xlabel("time per frame")
    axes.grid(visible=True, which="major", color="#E3E3E3")
    axes.grid(visible=True, which="minor", axis="x", color="#F1F1F1")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.set_title(
        f"{figures.scene}: {figures.tiles} tiles, {figures.draws} draws", loc="left", fontsize=11
    )
    return marks


def _top_n(figures: SceneFigures) -> float:
    highs = [m.figures["grf_mae_n"].high for m in figures.measured.values()]
    goals = GRF_MAE_N.get(figures.scene, {}).values()
    return 1.15 * max([high for high in highs if math.isfinite(high)] + list(goals) or [1.0])


def _time_text(ns: float, _: object = None) -> str:
    for unit, size in (("ms", 1e6), ("µs", 1e3)):
        if ns >= size:
            return f"{ns / size:g} {unit}"
    return f"{ns:g} ns"


def _time_text_between(ns: float, _: object = None) -> str:
    first_digit = f"{ns:e}"[0]
    return _time_text(ns) if first_digit in "25" else ""


def _legend(figure: Figure, axes: Axes) -> None:
    from matplotlib.lines import Line2D

    def mark(shape: str, face: str, edge: str, size: float, label: str) -> Line2D:
        return Line2D(
            *([], []),
            marker=shape,
            markerfacecolor=face,
            markeredgecolor=edge,
            markersize=size,
            linestyle="none",
            label=label,
        )

    modes = [
        mark(shape, colour, colour, 7, f"{mode}, looks {LAGS_MS[mode]:g} ms ahead")
        for mode, (colour, shape) in STYLES.items()
    ]
    handles = [
        *modes,
        mark("o", "white", GREY, 10, "the scene's own ladder"),
        mark("o", "white", GREY, 6, "that without one model"),
        Line2D([], [], color=GREY, linewidth=1.4, label="Pareto front"),
        Line2D([], [], color=GREY, linewidth=0.9, linestyle=(0, (5, 4)), label="goal"),
    ]
    handles[2].set_markeredgecolor("black")
    handles[2].set_markeredgewidth(1.8)
    handles[2].set_markerfacecolor("#BFBFBF")
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=6 if len(figure.axes) > 1 else 3,
        frameon=False,
        fontsize=9,
    )


def _label(axes: Axes, marks: Sequence[_Mark]) -> None:
    """Write every name where nothing is yet, as near to its mark as there is room."""
    renderer: Any = axes.figure.canvas.get_renderer()
    inside = axes.get_window_extent(renderer)
    places = [axes.transData.transform((x, y)) for x, y, *_ in marks]
    taken: list[Box] = [(x - 8, y - 8, x + 8, y + 8) for x, y in places]
    for place, (x, y, name, colour, is_default) in sorted(
        zip(places, marks, strict=True), key=lambda pair: not pair[1][4]
    ):
        text = axes.annotate(
            name,
            (x, y),
            xytext=(0, 0),
            textcoords="offset pixels",
            fontsize=9 if is_default else 8,
            fontweight="bold" if is_default else "normal",
            color=colour,
            zorder=6,
        )
        size = text.get_window_extent(renderer)
        bounds = (inside.x0, inside.y0, inside.x1, inside.y1)
        dx, dy = free_place(tuple(place), (size.width, size.height), taken, bounds)
        text.set_position((dx, dy))
        left, bottom = place[0] + dx, place[1] + dy
        taken.append((left, bottom, left + size.width, bottom + size.height))
        middle = (left + size.width / 2 - place[0], bottom + size.height / 2 - place[1])
        if abs(middle[0]) > size.width / 2 + 14 or abs(middle[1]) > size.height / 2 + 14:
            nearest = (
                min(max(place[0], left), left + size.width),
                min(max(place[1], bottom), bottom + size.height),
            )
            ends = axes.transData.inverted().transform([place, nearest])
            axes.plot(*ends.T, color=colour, linewidth=0.5, alpha=0.7, zorder=1)


def free_place(
    at: tuple[float, float],
    size: tuple[float, float],
    taken: Sequence[Box],
    inside: Box,
) -> tuple[float, float]:
    """Where the lower left corner of a text goes, relative to what it names; all in pixels.

    The nearest place at which it covers nothing; if there is none, the one that covers least.

    Args:
        at: what it names.
        size: width and height of the text.
        taken: boxes that are to be left free.
        inside: box in which the text has to be.
    """
    width, height = size
    best, least = (0.0, 0.0), math.inf
    for away in range(11, 240, 8):
        for turn in (0, 8, 4, 12, 2, 6, 10, 14, 1, 15, 3, 5, 7, 9, 11, 13):
            angle = turn * math.pi / 8
            dx = math.cos(angle) * (away + width / 2) - width / 2
            dy = math.sin(angle) * (away + height / 2) - height / 2
            left, bottom = at[0] + dx, at[1] + dy
            box = (left, bottom, left + width, bottom + height)
            outside = (
                box[0] < inside[0] or box[1] < inside[1] or box[2] > inside[2] or box[3] > inside[3]
            )
            if outside:
                continue
            covered = sum(_overlap(box, other) for other in taken)
            if covered == 0.0:
                return dx, dy
            if covered < least:
                best, least = (dx, dy), covered
    return best


def _overlap(a: Box, b: Box) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0
