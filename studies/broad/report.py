"""Report and figure of a run over the broad family."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from devices.emulation.parts import make_rng
from service.offline.accuracy import PHASES
from service.offline.figure_output import create_figure, render_png
from studies.benchmark.draws import LAGS_MS
from studies.benchmark.figures import (
    COVERAGE_GOAL,
    COVERAGE_TITLES,
    PHASE_COVERAGE_GOAL,
    Goal,
    Quantiles,
)
from studies.benchmark.report import EMULATED, GREY, STYLES, format_table
from studies.broad.arrays import CLEAN, CONDITIONS, HEAVY, SCENES, BroadBenchmarkResult
from studies.broad.figures import (
    ANY_PHASE,
    COP_P95_GOALS_MM,
    GRF_MAE_GOALS_N,
    MIN_EFFECT_N,
    CaseSummary,
    compare_errors_with_goals,
    compare_uncertainty_with_goals,
    count_models,
    needs_model,
    summarize_cases,
)
from studies.broad.results import ArrayResult, make_case_key

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEAVY = "a leg of 3.3 kg on firmer poppy seeds, up to 28 N a tile: for saturation, without a goal"


def format_broad_report(broad: BroadBenchmarkResult) -> str:
    """Format the report."""
    o, results = broad.options, broad.results
    rows = summarize_cases(results)
    spent_s = sum(result.cpu_bench_s + result.cpu_scenes_s for result in results)
    alike = "each array's own, 0 to 3 %" if o.repeatability is None else f"{o.repeatability:g}"
    lines = [
        "# Unseen domes",
        "",
        f"{broad.software}, code {broad.code_hash}, {broad.run_at}, on {broad.machine}.",
        "",
        f"{len(results)} arrays of four tiles of the broad family, seeds of {o.seeds}, each "
        f"calibrated on its own rig (repeatability there: {alike}), then run through every "
        f"scene with the scene's own models. {spent_s / 60:.0f} min CPU in all. Quantiles are over "
        "arrays, signs are dropped; coverage is pooled over the frames of all arrays.",
        "",
        EMULATED,
        "",
        *(f"- `{name}`: {meaning}" for name, meaning in {**CONDITIONS, HEAVY: _HEAVY}.items()),
        "",
        "## Goals",
        "",
        *_goals(broad),
        "",
        "## Errors",
        "",
        "Median, and 95th percentile of arrays.",
        "",
        *_errors(rows),
        "",
        "## Covered by the 95 % interval",
        "",
        "Pooled over frames, and in brackets the 5th percentile of arrays.",
        "",
        *_coverage(rows),
        "",
        "## Sigma over actual error",
        "",
        "Both root mean square; median, and 5 to 95 % of arrays.",
        "",
        *_ratios(rows),
        "",
        "## Saturation",
        "",
        "Frames in which any tile was called so, and tile by tile: how many, how many of them "
        "although what the load settles at is more than four times the noise below the calibrated "
        "end and the chip within its range, and in how many the stated bound holds.",
        "",
        *_saturation(rows),
        "",
        "## Models",
        "",
        f"A tile needs a model if its true effect on poppy seeds exceeds {MIN_EFFECT_N:g} N in the "
        "95th percentile of loaded frames; one in twenty has no effect at all.",
        "",
        *_models(broad),
        "",
        "## Refusals",
        "",
        *_refusals(broad),
    ]
    return "\n".join(lines) + "\n"


def _goals(broad: BroadBenchmarkResult) -> list[str]:
    errors, sigmas = (
        _format_goals(compare_errors_with_goals(broad.results)),
        _format_goals(compare_uncertainty_with_goals(broad.results)),
    )
    missed = [row for row in sigmas if row[-1] == "NO"]
    head = ("figure", "mode", "measured", "goal", "met")
    remark = (
        f"Of coverage, sigma and saturation {len(sigmas) - len(missed)} of {len(sigmas)} are met."
    )
    return [
        *format_table(head, errors),
        "",
        remark,
        *(["", *format_table(head, missed)] if missed else []),
    ]


def _format_goals(goals: Sequence[Goal]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for goal in goals:
        value = "-" if math.isnan(goal.value) else f"{goal.value:.3g}"
        requested = f"at most {goal.most:g}"
        if goal.least is not None:
            requested = f"{goal.least:g} to {goal.most:g}"
        rows.append((goal.figure, goal.mode, value, requested, "yes" if goal.is_met else "NO"))
    return rows


def _errors(rows: Sequence[CaseSummary]) -> list[str]:
    cells = [
        (
            *_place(row),
            str(row.errors["grf_mae_n"].n),
            _worst(row.errors["grf_mae_n"], 1.0, 3),
            _worst(row.errors["peak_error_n"], 1.0, 2),
            _worst(row.errors["cop_p95_m"], 1e3, 2),
            _worst(row.errors["flight_mean_n"], 1.0, 3),
        )
        for row in rows
    ]
    head = ("GRF mean abs N", "stance peak N", "COP 95th percentile mm", "flight, mean N")
    return format_table(("scene", "condition", "mode", "arrays", *head), cells)


def _coverage(rows: Sequence[CaseSummary]) -> list[str]:
    cells = [
        (
            *_place(row),
            *(
                _format_coverage(row.coverage[name].share, row.coverage_of_arrays[name].p5)
                for name in COVERAGE_TITLES
            ),
        )
        for row in rows
    ]
    return format_table(("scene", "condition", "mode", *COVERAGE_TITLES.values()), cells)


def _ratios(rows: Sequence[CaseSummary]) -> list[str]:
    cells = [
        (*_place(row), *(_range(row.sigma_over_rms[name]) for name in (ANY_PHASE, *PHASES)))
        for row in rows
    ]
    return format_table(
        ("scene", "condition", "mode", *(COVERAGE_TITLES[n] for n in (ANY_PHASE, *PHASES))), cells
    )


def _saturation(rows: Sequence[CaseSummary]) -> list[str]:
    cells = [
        (
            *_place(row),
            f"{row.sums['saturated_frames']} of {row.sums['frames']}",
            *(str(row.sums[name]) for name in ("saturated_tile_frames", "wrongly", "held")),
            f"{row.sums['grf_bounds_held']} of {row.sums['grf_bounds']}",
            str(row.sums["after_frames"]),
            _worst(row.after_saturation_mae_n, 1.0, 2),
        )
        for row in rows
        if row.sums["saturated_frames"] or row.sums["after_frames"]
    ]
    if not cells:
        return ["No frame was called saturated."]
    head = (
        *("frames", "tile frames", "wrongly", "tile's bound holds", "GRF's bound holds"),
        *("frames after", "GRF mean abs N there"),
    )
    return format_table(("scene", "condition", "mode", *head), cells)


def _models(broad: BroadBenchmarkResult) -> list[str]:
    rows = [
        (m.name, str(m.needed), str(m.lost), str(m.lacking), str(m.invented))
        for m in count_models(broad.results)
    ]
    return format_table(
        ("model", "tiles that need it", "lost it", "without effect", "given it"), rows
    )


def _refusals(broad: BroadBenchmarkResult) -> list[str]:
    rows, at_bound = [], Counter[str]()
    for result in broad.results:
        array = str(result.number)
        rows += [(array, refusal.what, "", refusal.why) for refusal in result.refusals]
        for tile in result.tiles:
            at_bound.update(tile.at_bound)
            rows += [
                (array, f"{tile.serial}, {name}", _effect(tile.effect_n.get(name)), why)
                for name, why in tile.refused.items()
                if name != "ambient" and (name in tile.lacks or needs_model(tile, name))
            ]
    rows += [("", refusal.what, "", refusal.why) for refusal in broad.lost_arrays]
    lines = [
        "Every array and scene that gave nothing, and every model that a tile was refused although "
        "it needs it, or lacks the effect; with the true effect.",
        "",
        *format_table(("array", "of", "true effect N", "reason"), rows),
    ]
    if at_bound:
        found = ", ".join(f"{name} {n}" for name, n in at_bound.most_common())
        lines += [
            "",
            f"Parameters found at the end of what is possible, in so many tiles: {found}.",
        ]
    return lines


def _format_coverage(share: float, worst: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f} % ({100 * worst:.0f})"


def _effect(effect_n: float | None) -> str:
    return "" if effect_n is None else f"{effect_n:.2f}"


def _place(row: CaseSummary) -> tuple[str, str, str]:
    return row.scene, row.condition, row.mode


def _worst(spread: Quantiles, scale: float, digits: int) -> str:
    if not spread.n:
        return "-"
    return f"{scale * spread.median:.{digits}f}, {scale * spread.p95:.{digits}f}"


def _range(spread: Quantiles) -> str:
    return f"{spread.median:.2f} ({spread.p5:.2f} to {spread.p95:.2f})" if spread.n else "-"


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
