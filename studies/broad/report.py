"""Markdown report of the broad benchmark: goals, errors, coverage, flags, models, refusals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from service.offline.accuracy import PHASES
from studies.benchmark.figures import COVERAGE_TITLES, Goal, Quantiles
from studies.benchmark.report import EMULATED, format_table
from studies.broad.arrays import CONDITIONS, HEAVY, BroadBenchmarkResult
from studies.broad.figures import (
    ANY_PHASE,
    MIN_EFFECT_N,
    CaseSummary,
    compare_errors_with_goals,
    compare_uncertainty_with_goals,
    count_models,
    needs_model,
    summarize_cases,
)

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
