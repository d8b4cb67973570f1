"""`foottile node`: acquisition beside the robot."""

from __future__ import annotations

import asyncio
import os
import re
import socket
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import CalibrationError, UsageError
from service.cli.emulation import (
    CopAxesOption,
    CopOffsetOption,
    CopScaleOption,
    LeadOption,
    LoadOption,
    LoadScaleOption,
    PartsSeedOption,
    SeedOption,
    rig_options,
    scene_with,
)
from service.cli.options import remark

if TYPE_CHECKING:
    from service.estimation.calibration import Calibration
    from service.rig import RigOptions


def node_command(
    scene: Annotated[str, typer.Option(help="Scene file, or a built-in scene.")],
    server: Annotated[str, typer.Option(help="Address of the server.")] = "http://127.0.0.1:8000",
    bus: Annotated[
        str | None, typer.Option(help="I2C bus, /dev/i2c-1 or emulated; default: the scene's.")
    ] = None,
    servo: Annotated[
        str | None,
        typer.Option(help="Serial port, emulated, or none; default: the scene's."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of this node; default: this machine's.")
    ] = None,
    load: LoadOption = None,
    load_scale: LoadScaleOption = 1.0,
    cop_scale: CopScaleOption = 1.0,
    cop_offset_m: CopOffsetOption = "0,0",
    cop_axes: CopAxesOption = "xy",
    lead_s: LeadOption = 1.0,
    seed: SeedOption = 0,
    parts_seed: PartsSeedOption = 0,
    end_with_parent: Annotated[
        bool, typer.Option("--end-with-parent", hidden=True, help="End when its parent dies.")
    ] = False,
) -> None:
    """Take frames from an array and publish them to a server.

    It keeps trying: when the server is away, frames wait in memory (64 MiB) and follow when it is
    back. A server that wants a token gets the one in FOOTTILE_TOKEN. Options from --load on are for
    emulated tiles. Ctrl-C ends it.
    """
    from service.publisher import ingest_url

    if end_with_parent:
        from devices import realtime

        realtime.end_with_parent()
    ingest_url(server)  # refuse a wrong address before anything else
    the_scene = scene_with(scene, bus=bus, servo=servo)
    options = rig_options(
        the_scene,
        _name(name),
        load=load,
        load_scale=load_scale,
        cop_scale=cop_scale,
        cop_offset_m=cop_offset_m,
        cop_axes=cop_axes,
        lead_s=lead_s,
        seed=seed,
        parts_seed=parts_seed,
    )
    calibration, problem = calibration_of(options)
    unsent = asyncio.run(_run(options, server, calibration, problem))
    if unsent:
        remark(f"{unsent} frames were never acknowledged by the server")
        raise typer.Exit(3)


async def _run(
    options: RigOptions, server: str, calibration: Calibration | None, problem: str | None
) -> int:
    from service.node import run_node
    from service.serve import stop_on_signals

    return await run_node(
        options,
        server,
        calibration=calibration,
        calibration_problem=problem,
        token=os.environ.get("FOOTTILE_TOKEN"),
        stop=stop_on_signals(),
        report=remark,
    )


def calibration_of(options: RigOptions) -> tuple[Calibration | None, str | None]:
    """The calibration that the scene names, or why there is none: raw frames are worth having."""
    from service.calibrations import BENCH, find_calibration

    scene = options.scene
    if scene.calibration == "none":
        return None, "the scene names no calibration"
    if scene.calibration == BENCH and not options.emulated:
        # The emulated bench would press an emulated tile of the same serial: plausible and wrong.
        problem = (
            "the emulated bench knows emulated tiles only: press the tiles on a real bench, run "
            "`foottile calibrate`, and name its file in the scene"
        )
        remark(f"no calibration, so no forces: {problem}")
        return None, problem
    try:
        calibration = find_calibration(
            scene.calibration,
            [tile.serial for tile in scene.tile if not tile.reference],
            parts_seed=options.parts_seed,
            progress=remark,
        )
    except CalibrationError as error:
        remark(f"no calibration, so no forces: {error}")
        return None, str(error)
    return calibration, None


def _name(given: str | None) -> str:
    name = given if given is not None else re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}", name):
        raise UsageError(
            f"--name {name!r}", expected="1 to 64 letters, digits, '.', '_' or '-', no '.' first"
        )
    return name
