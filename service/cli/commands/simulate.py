"""`foottile simulate`: sessions on emulated hardware in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from devices.errors import UsageError, require_extra
from devices.scene.hardware_sections import AnySchedule, ScheduleName
from devices.scene.scene_file import load_scene
from service.cli.options import (
    EXIT_INCOMPLETE,
    ChipOption,
    FootOptions,
    JsonOption,
    UnquantizedOption,
    add_options,
    check_emulated,
    echo,
    print_json,
    remark,
    resolve_output_path,
    show_progress,
)
from service.estimation import OFFLINE_LAG_MS

if TYPE_CHECKING:
    from service.offline.simulation import SimulationResult


@require_extra("server", "`foottile simulate`")
@add_options
def simulate_command(
    scene: Annotated[str, typer.Option(help="Built-in scene, or a scene file.")],
    out: Annotated[
        Path | None, typer.Option(help="Session to write; default: SCENE.parquet here.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Length with the lead; default: the load's or programme's."),
    ] = None,
    schedule: Annotated[
        str | None,
        typer.Option(
            help="auto, simultaneous, pipelined, per_mux or sequential; default: the scene's."
        ),
    ] = None,
    tiles: Annotated[
        str | None, typer.Option(help="Indentation only: serials under the indenter, T01,T02,...")
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Add the true_* columns and print the error.")
    ] = False,
    chip: ChipOption = None,
    no_estimates: Annotated[bool, typer.Option("--no-estimates", help="Raw frames only.")] = False,
    unquantized: UnquantizedOption = False,
    as_json: JsonOption = False,
    *,
    options: FootOptions,
) -> None:
    """Run a scene on emulated hardware in virtual time and write the session.

    The real driver reads emulated chips through an emulated bus; the same command and version give
    the same bytes. Exit codes: 0 success, 1 failure, 2 wrong usage, 3 written, but the bus is too
    slow for the scene's frame rate.
    """
    # Imported here: the physics imports numba, which would slow down `--help`.
    from service.estimation.pipeline.params import check_known_models_with_static
    from service.offline.calibration_lookup import find_calibration, replace_tiles
    from service.offline.simulation import SimulationOptions, run_simulation
    from service.rig.emulated_foot import make_injected_path
    from service.sessions.estimate_stream import EstimateOptions

    the_scene = load_scene(scene, chip)
    if tiles is not None:
        if the_scene.ground.kind != "indentation":
            raise UsageError("--tiles needs an indenter", expected="a scene with an indentation")
        the_scene = replace_tiles(the_scene, tiles.split(","))
    check_emulated(the_scene)
    if seconds is not None and not 0.0 < seconds < 1e9:
        raise UsageError(f"--seconds {seconds:g}", expected="a plausible positive number")
    foot = options.make_foot(the_scene)
    inputs = [Path(scene), *([options.load] if options.load is not None else [])]
    path = resolve_output_path(
        out if out is not None else Path(f"{the_scene.name}.parquet"), *inputs
    )
    has_estimates = not no_estimates and the_scene.calibration != "none"
    if has_estimates:
        check_known_models_with_static(the_scene.models)

    def estimate() -> EstimateOptions:
        calibration = find_calibration(
            the_scene.calibration,
            [tile.serial for tile in the_scene.tile if not tile.reference],
            chips={tile.serial: tile.chip for tile in the_scene.tile},
            parts_seed=foot.parts_seed,
            family=the_scene.emulation.family,
            on_progress=remark,
        )
        return EstimateOptions(
            calibration, the_scene.models, OFFLINE_LAG_MS, unquantized=unquantized
        )

    with show_progress(f"simulating {the_scene.name}"):
        result = run_simulation(
            SimulationOptions(
                scene=the_scene,
                seconds=seconds,
                schedule=_parse_schedule(schedule),
                with_truth=truth,
                foot=foot,
            ),
            path,
            estimate if has_estimates else None,
        )
    plates = foot.plates.paths_by_instrument
    if as_json:
        print_json({**_make_json(result, path), "plates": list(plates.values())})
    else:
        _print_result(result, path)
        for name, file in plates.items():
            echo(f"{file}: the {name}; {make_injected_path(file)}: what was injected into it")
    if result.missed_slots:
        raise typer.Exit(EXIT_INCOMPLETE)


def _make_json(result: SimulationResult, path: Path) -> dict[str, object]:
    from service.cli.report import make_findings_json

    pressed = result.indentation_trace
    return {
        "out": path,
        "frames": result.frame_count,
        "seconds": result.seconds,
        "rate_hz": result.rate_hz,
        "schedule": result.schedule_choice.schedule,
        "unmeasured": result.unmeasured_serials,
        "flags": result.flag_counts,
        "missed_slots": result.missed_slots,
        "bytes": path.stat().st_size,
        "moved_to_edge": pressed.moved_samples if pressed else None,
        "limited": pressed.limited_samples if pressed else None,
        **make_findings_json(result.findings),
    }


def _print_result(result: SimulationResult, path: Path) -> None:
    from service.cli.report import print_findings

    size = path.stat().st_size
    echo(
        f"{path}: {result.frame_count} frames in {result.seconds:.3f} s of virtual time, "
        f"{result.rate_hz:.1f} frames/s, {size} bytes ({size / result.frame_count:.1f} a frame)"
    )
    remark(
        f"{result.wall_s:.1f} s of wall time, {result.seconds / result.wall_s:.1f} times real time"
    )
    remark(f"schedule {result.schedule_choice.schedule}: {result.schedule_choice.reason}")
    for serial in result.unmeasured_serials:
        echo(f"tile {serial}: conversion time not measurable; the longest is assumed")
    for serial, flags in result.flag_counts.items():
        text = ", ".join(f"{n} {reason}" for reason, n in flags.items())
        echo(f"tile {serial}: of {result.frame_count} frames {text}")
    for serial in result.replaced_serials:
        echo(f"tile {serial} was replaced by another part: its readings are flagged from then on")
    if result.missed_slots:
        echo(f"{result.missed_slots} slots were missed: the bus cannot keep this rate")
    if (trace := result.indentation_trace) is not None:
        echo(
            f"load: {trace.moved_samples} samples had their COP moved to the hull's edge, "
            f"{trace.limited_samples} had a tile's force limited"
        )
    print_findings(result.findings)


def _parse_schedule(name: str | None) -> AnySchedule | None:
    if name is None:
        return None
    names = ("auto", *get_args(ScheduleName))
    if name not in names:
        raise UsageError(f"--schedule {name!r}", expected=" or ".join(names))
    return cast(AnySchedule, name)
