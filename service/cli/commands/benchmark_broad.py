"""`foottile benchmark --family broad`: quantiles of errors over arrays of unseen domes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import typer

from devices.errors import UsageError
from devices.scene.emulation_sections import PartFamily
from service.cli.options import echo, echo_lines, print_json, remark
from service.json_output import to_json_text

ARRAYS, QUICK_ARRAYS = 200, 3


def is_broad(family: str, options: Mapping[str, object]) -> bool:
    """Return whether the broad family is selected.

    Args:
        family: name of the family.
        options: options of the default family only; None if absent.

    Raises:
        UsageError: no such family, or an option of the other family.
    """
    choices = get_args(PartFamily)
    if family not in choices:
        raise UsageError(f"--family {family}", expected=" or ".join(choices))
    excluded = [option for option, value in options.items() if value is not None]
    if family == "broad" and excluded:
        raise UsageError(f"{', '.join(excluded)} and --family broad", expected="one or the other")
    return family == "broad"


def benchmark_broad(
    folder: Path,
    *,
    arrays: int,
    seeds: str,
    jobs: int,
    repeatability: float | None,
    check_goals: bool,
    as_json: bool,
) -> None:
    """Run the arrays without a result in the folder, and write broad.json, .md and .png.

    Raises:
        UsageError: no such seeds.
        Exit: 3, for a missing result, or with `check_goals` a missed goal.
    """
    from service.offline.figure_output import create_figure
    from storage.durable_files import write_atomically
    from studies.broad.figures import (
        compare_with_goals,
        count_models,
        summarize_cases,
    )
    from studies.broad.plot import plot_broad
    from studies.broad.report import format_broad_report
    from studies.broad.results import Seeds
    from studies.broad.run import BroadOptions, run_broad_benchmark

    choices: dict[str, Seeds] = {name: name for name in get_args(Seeds)}
    if seeds not in choices:
        raise UsageError(f"--seeds {seeds}", expected=" or ".join(choices))
    create_figure(1.0, 1.0)  # reports a missing package early
    broad = run_broad_benchmark(
        BroadOptions(arrays, choices[seeds], jobs, folder, repeatability), remark
    )
    text = format_broad_report(broad)
    goals = compare_with_goals(broad.results)
    content = {
        "software": broad.software,
        "code": broad.code_hash,
        "made": broad.run_at,
        "machine": broad.machine,
        "seeds": seeds,
        "arrays": len(broad.results),
        "repeatability": repeatability,
        "goals": goals,
        "rows": summarize_cases(broad.results),
        "models": count_models(broad.results),
        "results": [result.model_dump() for result in broad.results],
    }
    write_atomically(folder / "broad.json", to_json_text(content).encode())
    write_atomically(folder / "broad.md", text.encode())
    write_atomically(folder / "broad.png", plot_broad(broad.results))
    if as_json:
        print_json(content)
    else:
        echo_lines(text)
        echo(f"{folder}: broad.json, broad.md, broad.png")
    refused = [(f"array {r.number}, {f.what}", f.why) for r in broad.results for f in r.refusals]
    for what, why in [*refused, *((f.what, f.why) for f in broad.lost_arrays)]:
        remark(f"no result: {what}: {why}")
    missed = [goal for goal in goals if not goal.is_met]
    if check_goals:
        for goal in missed:
            remark(f"goal not met: {goal.mode}: {goal.figure}: {goal.value:.3g}")
    if refused or broad.lost_arrays or (check_goals and missed):
        raise typer.Exit(3)
