"""`foottile benchmark`: speed against error of the model ladder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, require_extra
from devices.scene.scene_file import load_scene
from service.cli.commands.benchmark_broad import ARRAYS, QUICK_ARRAYS, benchmark_broad, is_broad
from service.cli.options import (
    JsonOption,
    check_emulated,
    print_json,
    progress,
    remark,
    say,
    say_lines,
)
from service.cli.result_folder import result_folder
from service.json_output import to_json_text

SCENES = ("rolling", "poppy", "mud")
DRAWS, QUICK_DRAWS = 20, 3
FRAMES, QUICK_FRAMES = 1_000_000, 100_000
LIVE_FRAMES, QUICK_LIVE_FRAMES = 10_000, 2_000
SECONDS_MAX = 1000.0
"""A draw is held in memory: at 500 frames/s and four tiles this is about 100 MB."""
FRAMES_MAX = 10_000_000
DRAWS_MAX = 100_000
JOBS_MAX = 1024
REPETITIONS, QUICK_REPETITIONS = 5, 3


@require_extra("server", "`foottile benchmark`")
def benchmark_command(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for bench.json, bench.md and bench.png (broad.*); made if absent."
        ),
    ],
    scene: Annotated[
        list[str] | None,
        typer.Option(help=f"Scene, can be given again; default: {', '.join(SCENES)}."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help=f"{QUICK_DRAWS} draws and fewer timed frames, for a first look."
        ),
    ] = False,
    draws: Annotated[
        int | None,
        typer.Option(
            min=1, max=DRAWS_MAX, help=f"Draws of tiles, calibration and noise; default {DRAWS}."
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Length of a draw; default: the scene's, or 20 if it has no end."),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, max=FRAMES_MAX, help=f"Frames timed offline; default {FRAMES}."),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=JOBS_MAX, help="Draws at the same time; default: one per core."),
    ] = None,
    whole_only: Annotated[
        bool, typer.Option("--full-only", help="Only the scenes' whole ladders, for many draws.")
    ] = False,
    repeatability: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=0.2,
            help="Of the emulated domes, instead of the scene's; the paper's: 0.03.",
        ),
    ] = None,
    correlated_ms: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1000.0,
            help="Correlation time of the emulated noise, instead of the scene's.",
        ),
    ] = None,
    family: Annotated[
        str,
        typer.Option(
            help="Of emulated parts: default; or broad: arrays of domes nobody has seen, each "
            f"with its own bench, {ARRAYS} unless --draws says otherwise. A run that was broken "
            "off goes on, if its folder is the same."
        ),
    ] = "default",
    seeds: Annotated[
        str,
        typer.Option(
            help="Of the broad family's arrays: development; or judgement, from which no constant "
            "of the estimator may be set."
        ),
    ] = "development",
    check_goals: Annotated[
        bool, typer.Option("--check-goals", help="Exit code 3 if a goal is not met.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure time and error of every model set.

    Each draw has other tiles, calibrated on the emulated bench as a user would, and other noise.
    Rungs are built up model by model to the scene's whole ladder, and the whole is tried without
    each of its models. Exit codes: 0 good, 1 failed, 2 wrong usage, 3 written, but something could
    not be measured (or, with --check-goals, a goal is not met).
    """
    if is_broad(
        family,
        {
            "--scene": scene,
            "--seconds": seconds,
            "--frames": frames,
            "--correlated-ms": correlated_ms,
            "--full-only": whole_only or None,
        },
    ):
        with result_folder(out) as folder:
            benchmark_broad(
                folder,
                arrays=draws or (QUICK_ARRAYS if quick else ARRAYS),
                seeds=seeds,
                jobs=jobs or os.cpu_count() or 1,
                repeatability=repeatability,
                check_goals=check_goals,
                as_json=as_json,
            )
        return
    from service.offline.benchmark.plot import plot_benchmark
    from service.offline.benchmark.report import format_benchmark_report
    from service.offline.benchmark.run import BenchmarkOptions, run_benchmark
    from service.offline.figure_output import create_figure
    from storage.durable_files import write_atomically

    scenes = tuple(load_scene(name) for name in scene or SCENES)
    names = [the_scene.name for the_scene in scenes]
    if len(set(names)) < len(names):
        raise UsageError(f"scenes {', '.join(names)}", expected="each scene once")
    for the_scene in scenes:
        check_emulated(the_scene)
    if seconds is not None and not 0.0 < seconds <= SECONDS_MAX:
        raise UsageError(f"--seconds {seconds:g}", expected=f"0 to {SECONDS_MAX:g}")
    create_figure(1.0, 1.0)  # says what is missing before anything takes time
    options = BenchmarkOptions(
        scenes=scenes,
        draws=draws or (QUICK_DRAWS if quick else DRAWS),
        seconds=seconds,
        process_count=jobs or os.cpu_count() or 1,
        offline_frames=frames or (QUICK_FRAMES if quick else FRAMES),
        live_frames=QUICK_LIVE_FRAMES if quick else LIVE_FRAMES,
        repetitions=QUICK_REPETITIONS if quick else REPETITIONS,
        full_only=whole_only,
        repeatability=repeatability,
        correlated_ms=correlated_ms,
    )
    with result_folder(out) as folder:
        with progress("starting") as tell:
            bench = run_benchmark(options, tell)
            text, png = format_benchmark_report(bench), plot_benchmark(bench.scenes)
        content = to_json_text(bench.as_dict())
        write_atomically(folder / "bench.json", content.encode())
        write_atomically(folder / "bench.md", text.encode())
        write_atomically(folder / "bench.png", png)
    if as_json:
        print_json(bench.as_dict())
    else:
        say_lines(text)
        say(f"{folder}: bench.json, bench.md, bench.png")
    for name, failure in bench.failures:
        remark(f"not measured: {name}, {failure.what}: {failure.why}")
    missed = [
        (name, goal) for name, goals in bench.goals.items() for goal in goals if not goal.is_met
    ]
    if check_goals:
        for name, goal in missed:
            remark(f"goal not met: {name}, {goal.mode}: {goal.figure}: {goal.value:.3g}")
    if bench.failures or (check_goals and missed):
        raise typer.Exit(3)
