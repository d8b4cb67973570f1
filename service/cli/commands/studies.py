"""`foottile benchmark` and `foottile reproduce`: error against time; the paper's experiments."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, get_args

import typer

from devices.errors import UsageError, require_extra
from devices.scene.emulation_sections import PartFamily
from devices.scene.scene_file import load_scene
from service.cli.options import (
    SEED_MAX,
    ChipOption,
    EstimatorOption,
    JsonOption,
    check_emulated,
    echo,
    echo_lines,
    exit_incomplete_for,
    open_result_folder,
    print_json,
    remark,
    show_progress,
)
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
    from studies.broad.arrays import BroadOptions, run_broad_benchmark
    from studies.broad.figures import compare_with_goals, count_models, summarize_cases
    from studies.broad.report import format_broad_report, plot_broad
    from studies.broad.results import Seeds

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
    figures = {"broad.png": plot_broad(broad.results)}
    _write_and_print_result(folder, "broad", content, text, figures, as_json=as_json)
    refused = [(f"array {r.number}, {f.what}", f.why) for r in broad.results for f in r.refusals]
    lost = [*refused, *((f.what, f.why) for f in broad.lost_arrays)]
    missed = [goal for goal in goals if check_goals and not goal.is_met]
    exit_incomplete_for(
        [f"no result: {what}: {why}" for what, why in lost]
        + [f"goal not met: {goal.mode}: {goal.figure}: {goal.value:.3g}" for goal in missed]
    )


def _write_and_print_result(
    folder: Path,
    name: str,
    content: object,
    text: str,
    figures: Mapping[str, bytes],
    *,
    as_json: bool,
) -> None:
    """Write a result as JSON, Markdown and figures, and print it as JSON or text."""
    from storage.durable_files import write_atomically

    files = {f"{name}.json": to_json_text(content).encode(), f"{name}.md": text.encode(), **figures}
    for file_name, data in files.items():
        write_atomically(folder / file_name, data)
    if as_json:
        print_json(content)
    else:
        echo_lines(text)
        echo(f"{folder}: {', '.join(files)}")


SCENES = ("rolling", "poppy", "mud")
DRAWS, QUICK_DRAWS = 20, 3
FRAMES, QUICK_FRAMES = 1_000_000, 100_000
LIVE_FRAMES, QUICK_LIVE_FRAMES = 10_000, 2_000
SECONDS_MAX = 1000.0
"""Longest draw in memory: about 100 MB at 500 frames/s and four tiles."""
FRAMES_MAX = 10_000_000
DRAWS_MAX = 100_000
JOBS_MAX = 1024
REPETITIONS, QUICK_REPETITIONS = 5, 3


@require_extra("server", "`foottile benchmark`")
def benchmark_command(
    out: Annotated[
        Path,
        typer.Option(help="Folder for benchmark.json, .md and .png (broad.*); created if missing."),
    ],
    scene: Annotated[
        list[str] | None,
        typer.Option(help=f"Scene, repeatable; default: {', '.join(SCENES)}."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help=f"Quick run: {QUICK_DRAWS} draws and fewer timed frames."),
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
        typer.Option(min=1, max=JOBS_MAX, help="Parallel draws; default: one per core."),
    ] = None,
    estimator: EstimatorOption = "models",
    full_only: Annotated[
        bool,
        typer.Option("--full-only", help="Full model sets of the scenes only, for many draws."),
    ] = False,
    repeatability: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=0.2,
            help="Override the domes' repeatability (paper: 0.03).",
        ),
    ] = None,
    correlated_ms: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1000.0,
            help="Override the correlation time of the noise.",
        ),
    ] = None,
    family: Annotated[
        str,
        typer.Option(
            help="Family of emulated parts: default; or broad: arrays of unseen domes, each with "
            f"its own rig, {ARRAYS} of them without --draws. In the same folder an interrupted run "
            "continues."
        ),
    ] = "default",
    seeds: Annotated[
        str,
        typer.Option(
            help="Seeds of the broad family: development; or judgement, which must not be used to "
            "set constants of the estimator."
        ),
    ] = "development",
    chip: ChipOption = None,
    check_goals: Annotated[
        bool, typer.Option("--check-goals", help="Exit code 3 if a goal is not met.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure time and error of every model set.

    Each draw has other noise and other tiles, calibrated on the emulated rig. Model sets grow model
    by model to the scene's full set, which is also tried without each of its models. Exit codes: 0
    success, 1 failure, 2 wrong usage, 3 written, but with missing results (or, with --check-goals,
    a missed goal).
    """
    if is_broad(
        family,
        {
            "--scene": scene,
            "--seconds": seconds,
            "--frames": frames,
            "--correlated-ms": correlated_ms,
            "--chip": chip,
            "--full-only": full_only or None,
            "--estimator": None if estimator == "models" else estimator,
        },
    ):
        with open_result_folder(out) as folder:
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
    from service.offline.figure_output import create_figure
    from studies.benchmark.report import format_benchmark_report, plot_benchmark
    from studies.benchmark.run import BenchmarkOptions, run_benchmark
    from studies.estimators import get_estimator

    scenes = tuple(load_scene(name, chip) for name in scene or SCENES)
    names = [the_scene.name for the_scene in scenes]
    if len(set(names)) < len(names):
        raise UsageError(f"scenes {', '.join(names)}", expected="each scene once")
    for the_scene in scenes:
        check_emulated(the_scene)
    if seconds is not None and not 0.0 < seconds <= SECONDS_MAX:
        raise UsageError(f"--seconds {seconds:g}", expected=f"0 to {SECONDS_MAX:g}")
    create_figure(1.0, 1.0)  # reports a missing package early
    options = BenchmarkOptions(
        scenes=scenes,
        draws=draws or (QUICK_DRAWS if quick else DRAWS),
        seconds=seconds,
        process_count=jobs or os.cpu_count() or 1,
        offline_frames=frames or (QUICK_FRAMES if quick else FRAMES),
        live_frames=QUICK_LIVE_FRAMES if quick else LIVE_FRAMES,
        repetitions=QUICK_REPETITIONS if quick else REPETITIONS,
        full_only=full_only,
        repeatability=repeatability,
        correlated_ms=correlated_ms,
        estimator=get_estimator(estimator),
    )
    with open_result_folder(out) as folder:
        with show_progress("starting") as report_step:
            result = run_benchmark(options, report_step)
            text = format_benchmark_report(result)
            figures = {"benchmark.png": plot_benchmark(result.scenes)}
        _write_and_print_result(
            folder, "benchmark", result.as_dict(), text, figures, as_json=as_json
        )
    exit_incomplete_for(
        [f"not measured: {name}, {each.what}: {each.why}" for name, each in result.failures]
        + [
            f"goal not met: {name}, {goal.mode}: {goal.figure}: {goal.value:.3g}"
            for name, goals in result.goals.items()
            for goal in goals
            if check_goals and not goal.is_met
        ]
    )


TRIALS_MAX, TRIAL_JOBS_MAX = 100, 64


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
        typer.Option(
            min=1, max=TRIAL_JOBS_MAX, help="Parallel trials; default: one per core, up to 2."
        ),
    ] = None,
    angle: Annotated[
        str,
        typer.Option(help="Angle of the rolling foot: servo; or video, also from a rendered film."),
    ] = "servo",
    as_json: JsonOption = False,
) -> None:
    """Repeat the paper's experiments on emulated hardware.

    An indenter loads six domes; a foot is calibrated, rolls over a pressure plate and hops on a
    force plate. Node and server are processes, over loopback and in real time. Exit codes: 0
    success, 1 failure, 2 wrong usage, 3 written, but with missing results.
    """
    from service.offline.figure_output import create_figure
    from service.video.worker import check_extra_installed
    from studies.reproduce.experiments import TRIALS
    from studies.reproduce.figures import draw_figures
    from studies.reproduce.report import format_reproduction_report
    from studies.reproduce.run import QUICK_TRIALS, ReproduceOptions, run_reproduction

    create_figure(1.0, 1.0)  # reports a missing package early
    if angle not in ("servo", "video"):
        raise UsageError(f"--angle {angle}", expected="servo or video")
    if angle == "video":
        check_extra_installed()
    options = ReproduceOptions(
        seed=seed,
        parts_seed=parts_seed,
        trials=trials or (QUICK_TRIALS if quick else TRIALS),
        jobs=jobs or min(2, os.cpu_count() or 1),
        quick=quick,
        films_angle=angle == "video",
    )
    with open_result_folder(out) as folder:
        with show_progress("starting") as report_step:
            result = run_reproduction(options, folder, report_step)
            text, figures = format_reproduction_report(result), draw_figures(result)
        _write_and_print_result(folder, "reproduce", result, text, figures, as_json=as_json)
    exit_incomplete_for([f"not measured: {name}: {why}" for name, why in result.failures.items()])
