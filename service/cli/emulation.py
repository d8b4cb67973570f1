"""Options of an emulated foot, shared by the commands that run one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError
from devices.scene.file import Scene, load_scene
from devices.scene.hardware import EMULATED
from service.cli.options import pair

if TYPE_CHECKING:
    from service.rig.rig import RigOptions

LoadOption = Annotated[
    Path | None, typer.Option(help="Recorded load to press instead of the scene's ground.")
]
LoadScaleOption = Annotated[float, typer.Option(help="Factor on every force of the load.")]
CopScaleOption = Annotated[float, typer.Option(help="Factor on the load's COP about its mean.")]
CopOffsetOption = Annotated[
    str, typer.Option(metavar="X,Y", help="Where the load's mean COP comes to lie.")
]
CopAxesOption = Annotated[
    str, typer.Option(help="Axes of the load that become x and y: xy, yx, -yx, ...")
]
LeadOption = Annotated[float, typer.Option(help="Seconds without load first: the tare.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Draws noise and ground, not the parts.")]
PartsSeedOption = Annotated[int, typer.Option(min=0, help="Draws other parts.")]


def check_emulated(scene: Scene) -> None:
    """Refuse a scene of real hardware in a command that only emulates.

    Raises:
        UsageError: its bus or its servo is real.
    """
    if scene.array.bus != EMULATED:
        raise UsageError(
            f"scene {scene.name!r} is for {scene.array.bus}, and this command only emulates",
            remedy='Set array.bus = "emulated"',
        )
    if scene.servo is not None and scene.servo.port != EMULATED:
        raise UsageError(
            f"the servo of scene {scene.name!r} is at {scene.servo.port}, and this command only "
            "emulates",
            remedy='Set servo.port = "emulated"',
        )


def check_load(load_scale: float, cop_scale: float, lead_s: float) -> None:
    """Refuse numbers that cannot be meant.

    Raises:
        UsageError: one of them.
    """
    for option, value, least in (
        ("--load-scale", load_scale, 0.0),
        ("--cop-scale", cop_scale, None),
        ("--lead-s", lead_s, -1e-9),
    ):
        if not abs(value) < 1e9 or (least is not None and value <= least):
            raise UsageError(f"{option} {value:g}", expected="a sensible positive number")


def rig_options(
    scene: Scene,
    node: str,
    *,
    load: Path | None,
    load_scale: float,
    cop_scale: float,
    cop_offset_m: str,
    cop_axes: str,
    lead_s: float,
    seed: int,
    parts_seed: int,
) -> RigOptions:
    """What a node is to open.

    Raises:
        UsageError: options that do not fit.
        LoadTraceError: the load is not readable.
    """
    from devices.emulation.ground.load_trace import CopTransform
    from service.rig.rig import RigOptions
    from storage.formats.load_trace import read_load_trace

    check_load(load_scale, cop_scale, lead_s)
    if load is not None and scene.array.bus != EMULATED:
        raise UsageError("--load presses emulated tiles only", remedy="Add --bus emulated")
    if scene.array.bus == EMULATED and scene.ground.kind == "trace" and load is None:
        raise UsageError(
            f"scene {scene.name!r} presses a recorded load, and none was given",
            remedy="Add --load FILE",
        )
    return RigOptions(
        scene=scene,
        node=node,
        load=read_load_trace(load) if load is not None else None,
        load_scale=load_scale,
        cop=CopTransform(cop_scale, pair(cop_offset_m, "--cop-offset-m") or (0.0, 0.0), cop_axes),
        lead_s=lead_s,
        seed=seed,
        parts_seed=parts_seed,
    )


def scene_with(name: str, *, bus: str | None, servo: str | None) -> Scene:
    """A scene, on another bus or with its servo elsewhere if that is asked for.

    Raises:
        SceneError: no such scene.
        UsageError: a servo's port for a scene without servo.
    """
    scene = load_scene(name)
    if bus is not None:
        scene = scene.model_copy(update={"array": scene.array.model_copy(update={"bus": bus})})
    if servo == "none":
        return scene.model_copy(update={"servo": None})
    if servo is not None:
        if scene.servo is None:
            raise UsageError(
                f"scene {scene.name!r} has no servo, and --servo {servo} names its port",
                remedy="Add a [servo] section to the scene",
            )
        scene = scene.model_copy(update={"servo": scene.servo.model_copy(update={"port": servo})})
    return scene
