"""`foottile reproduce`: the paper's experiments, end to end, on emulated hardware."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import needs_extra
from service.cli.options import (
    SEED_MAX,
    JsonOption,
    print_json,
    progress,
    remark,
    say,
    say_lines,
)
from service.cli.result_folder import result_folder
from service.plain_json import json_text

TRIALS_MAX, JOBS_MAX = 100, 64


@needs_extra("server", "`foottile reproduce`")
def reproduce_command(
    out: Annotated[
        Path,
        typer.Option(help="Folder for reproduce.md, reproduce.json, figures and all recordings."),
    ],
    quick: Annotated[
        bool,
        typer.Option("--quick", help="One dome and one trial of rolling, for a first look."),
    ] = False,
    trials: Annotated[
        int | None,
        typer.Option(min=1, max=TRIALS_MAX, help="Of each experiment; default 4, quick 1."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX - TRIALS_MAX, help="Draws noise, ground, plates.")
    ] = 0,
    parts_seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Draws other parts.")] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=JOBS_MAX, help="At the same time; default: one per core, up to 2."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Repeat the paper's experiments on emulated hardware.

    Six domes are pressed, a foot is calibrated, rolls over a pressure plate and hops on a force
    plate; node and server are processes of their own, over loopback and in real time. Exit codes: 0
    good, 1 failed, 2 wrong usage, 3 written, but something could not be measured.
    """
    from service.cli.reproduction import QUICK_TRIALS, ReproduceOptions, reproduce
    from service.offline.plots import new_figure
    from service.offline.reproduce.figures import figures_of
    from service.offline.reproduce.report import markdown
    from service.offline.reproduce.setups import TRIALS
    from storage.durable import write_whole

    new_figure(1.0, 1.0)  # says what is missing before anything takes time
    options = ReproduceOptions(
        seed=seed,
        parts_seed=parts_seed,
        trials=trials or (QUICK_TRIALS if quick else TRIALS),
        jobs=jobs or min(2, os.cpu_count() or 1),
        quick=quick,
    )
    with result_folder(out) as folder:
        with progress("starting") as tell:
            result = reproduce(options, folder, tell)
            text, figures = markdown(result), figures_of(result)
        content = json_text(result)
        write_whole(folder / "reproduce.json", content.encode())
        write_whole(folder / "reproduce.md", text.encode())
        for name, png in figures.items():
            write_whole(folder / name, png)
    if as_json:
        print_json(result)
    else:
        say_lines(text)
        say(f"{folder}: reproduce.json, reproduce.md, {', '.join(figures)}")
    for name, why in result.failures.items():
        remark(f"not measured: {name}: {why}")
    if result.failures:
        raise typer.Exit(3)
