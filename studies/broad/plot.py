"""Plot of every array's errors by scene and condition, with quantiles, and coverage by phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from devices.emulation.parts import make_rng
from service.offline.accuracy import PHASES
from service.offline.figure_output import create_figure, render_png
from studies.benchmark.draws import LAGS_MS
from studies.benchmark.figures import COVERAGE_GOAL, PHASE_COVERAGE_GOAL
from studies.benchmark.plot import GREY, STYLES
from studies.broad.arrays import CLEAN, CONDITIONS, SCENES
from studies.broad.figures import (
    ANY_PHASE,
    COP_P95_GOALS_MM,
    GRF_MAE_GOALS_N,
    CaseSummary,
    summarize_cases,
)
from studies.broad.results import ArrayResult, make_case_key

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_APART = 0.2
_WIDTH = 0.14


def plot_broad(results: Sequence[ArrayResult]) -> bytes:
    """Draw the plot as a PNG.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    rows = summarize_cases(results)
    figure = create_figure(13.5, 1.2 + 3.4 * len(SCENES))
    panels = figure.subplots(len(SCENES), 3, squeeze=False)
    for scene, (force, centre, coverage) in zip(SCENES, panels, strict=True):
        _plot_arrays(force, results, scene, "grf_mae_n", 1.0, GRF_MAE_GOALS_N[scene])
        _plot_arrays(centre, results, scene, "cop_p95_m", 1e3, COP_P95_GOALS_MM)
        _plot_coverage(coverage, [row for row in rows if row.scene == scene])
        force.set_ylabel("GRF error, mean absolute, N")
        centre.set_ylabel("COP error, 95th percentile, mm")
        coverage.set_ylabel("covered by the 95 % interval, %")
        force.set_title(scene, loc="left", fontsize=12)
    for mode, (colour, shape) in STYLES.items():
        label = f"{mode}, {LAGS_MS[mode]:g} ms look-ahead"
        panels[0][0].plot([], [], shape, color=colour, label=label)
    panels[0][0].plot([], [], "-", color="black", label="median")
    panels[0][0].plot([], [], "-", color="black", linewidth=0.8, label="5 to 95 % of arrays")
    panels[0][0].plot([], [], ":", color=GREY, label="goals: median, 95th percentile")
    panels[0][0].plot([], [], "o", color=GREY, markersize=6, label="coverage: clean; and with")
    others = ", ".join(name for name in CONDITIONS if name != CLEAN)
    panels[0][0].plot(
        *([], []), "o", color=GREY, markersize=3.5, markerfacecolor="white", label=others
    )
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    refused = sum(result.tiles_refused > 0 for result in results)
    but = f", {refused} of them without a calibration" if refused else ""
    figure.suptitle(f"{len(results)} arrays of unseen domes{but}", fontsize=14)
    return render_png(figure)


def _plot_arrays(
    axes: Axes,
    results: Sequence[ArrayResult],
    scene: str,
    name: str,
    scale: float,
    goals: dict[str, tuple[float, float]],
) -> None:
    """Draw arrays as dots, with median and range, under each condition."""
    for at, condition in enumerate(CONDITIONS):
        for side, (mode, (colour, shape)) in zip((-1, 1), STYLES.items(), strict=True):
            key = make_case_key(scene, condition, mode)
            values = [getattr(r.judged[key], name) for r in results if key in r.judged]
            known = scale * np.array([value for value in values if value is not None])
            x = at + side * _APART
            if condition == CLEAN:
                axes.hlines(goals[mode], x - _WIDTH, x + _WIDTH, colors=GREY, linestyles=":")
            if not len(known):
                continue
            aside = make_rng(key).uniform(-0.6 * _WIDTH, 0.6 * _WIDTH, len(known))
            axes.plot(x + aside, known, shape, color=colour, markersize=3.5, alpha=0.5)
            low, median, high = np.percentile(known, [5, 50, 95]).tolist()
            axes.hlines(median, x - _WIDTH, x + _WIDTH, colors="black", linewidth=2.0, zorder=4)
            axes.vlines(x, low, high, colors="black", linewidth=0.8, zorder=4)
    axes.set_xticks(range(len(CONDITIONS)), list(CONDITIONS))
    axes.set_ylim(bottom=0.0)
    _remove_frame(axes)


def _plot_coverage(axes: Axes, rows: Sequence[CaseSummary]) -> None:
    """Draw pooled coverage by phase; large dots: clean scenes, small dots: other conditions."""
    names = (ANY_PHASE, *PHASES)
    for row in rows:
        if row.condition not in CONDITIONS:
            continue
        colour, shape = STYLES[row.mode]
        side = _APART * (-1 if row.mode == "live" else 1)
        aside = 0.1 * (list(CONDITIONS).index(row.condition) - 1.5)
        shares = [100 * row.coverage[name].share for name in names]
        at = np.arange(len(names)) + side + aside
        is_clean = row.condition == CLEAN
        axes.plot(
            *(at, shares),
            shape,
            color=colour,
            markersize=6 if is_clean else 3.5,
            markerfacecolor=colour if is_clean else "white",
        )
    for i, name in enumerate(names):
        low, high = COVERAGE_GOAL if name == ANY_PHASE else PHASE_COVERAGE_GOAL
        axes.fill_between([i - 0.45, i + 0.45], 100 * low, 100 * high, color=GREY, alpha=0.15)
    axes.set_xticks(range(len(names)), [name.replace("_", "-") for name in names], fontsize=9)
    axes.set_ylim(top=100.5)
    _remove_frame(axes)


def _remove_frame(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GREY, alpha=0.15)
