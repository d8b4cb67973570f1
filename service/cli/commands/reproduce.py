"""`foottile reproduce`: the paper's experiments on emulated hardware."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import require_extra
from service.cli.options import (
    SEED_MAX,
    JsonOption,
    echo,
    echo_lines,
    print_json,
    remark,
    show_progress,
)
from service.cli.report import open_result_folder
from service.json_output import to_json_text

TRIALS_MAX, JOBS_MAX = 100, 64


@require_extra("server", "`foottile reproduce`")
def reproduce_command(
    out: Annotated[
        Path,
        typer.Option(help="Folder for reproduce.md, reproduce.json, figures and all recordings."),
    ],
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Quick run: one dome and one trial of rolling."),
    ] = False,
    trials: Annotated[
        int | None,
        typer.Option(min=1, max=TRIALS_MAX, help="Trials of each experiment; default 4, quick 1."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX - TRIALS_MAX, help="Random seed of noise and ground.")
    ] = 0,
    parts_seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Random seed of parts.")] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=JOBS_MAX, help="Parallel trials; default: one per core, up to 2."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Repeat the paper's experiments on emulated hardware.

    An indenter loads six domes; a foot is calibrated, rolls over a pressure plate and hops on a
    force plate. Node and server are processes, over loopback and in real time. Exit codes: 0
    success, 1 failure, 2 wrong usage, 3 written, but with missing results.
    """
    from service.offline.figure_output import create_figure
    from storage.durable_files import write_atomically
    from studies.reproduce.figures import draw_figures
    from studies.reproduce.report import format_reproduction_report
    from studies.reproduce.run import QUICK_TRIALS, ReproduceOptions, run_reproduction
    from studies.reproduce.trials import TRIALS

    create_figure(1.0, 1.0)  # reports a missing package early
    options = ReproduceOptions(
        seed=seed,
        parts_seed=parts_seed,
        trials=trials or (QUICK_TRIALS if quick else TRIALS),
        jobs=jobs or min(2, os.cpu_count() or 1),
        quick=quick,
    )
    with open_result_folder(out) as folder:
        with show_progress("starting") as report_step:
            result = run_reproduction(options, folder, report_step)
            text, figures = format_reproduction_report(result), draw_figures(result)
        content = to_json_text(result)
        write_atomically(folder / "reproduce.json", content.encode())
        write_atomically(folder / "reproduce.md", text.encode())
        for name, png in figures.items():
            write_atomically(folder / name, png)
    if as_json:
        print_json(result)
    else:
        echo_lines(text)
        echo(f"{folder}: reproduce.json, reproduce.md, {', '.join(figures)}")
    for name, why in result.failures.items():
        remark(f"not measured: {name}: {why}")
    if result.failures:
        raise typer.Exit(3)
