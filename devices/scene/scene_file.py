"""Scene files: wiring of the tiles, ground, and settings of the estimate.

A scene is TOML. The class of each section lists its keys with unit and default. An unknown key, a
wrong type or a contradiction is a `SceneError` that names the key and the remedy. Built-in scenes
are files of the same form in `devices/scene/builtin/`.

The sections are in `devices.scene.hardware_sections` and `devices.scene.emulation_sections`.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Self, get_args

from pydantic import Field, ValidationError, field_validator, model_validator

from devices.errors import SceneError
from devices.input_files import read_text
from devices.scene.emulation_sections import (
    EmulationSection,
    FaultSection,
    GroundSection,
    MudGround,
    NoGround,
    ServoFault,
)
from devices.scene.hardware_sections import (
    ArraySection,
    Name,
    NotNegative,
    RecoverySection,
    ReferenceSection,
    SceneSection,
    ServoSection,
    SyncSection,
    TileSection,
)
from devices.types import MODELS_MAX, RATE_HZ_MIN, Identifier


class Scene(SceneSection):
    """Content of a scene file."""

    name: Name
    models: tuple[Identifier, ...] = Field(
        default=("unwrap", "static"), max_length=MODELS_MAX, strict=False
    )
    """Models of the estimate, in any order."""
    rate_hz: NotNegative = 0.0
    """Frame rate; 0: as fast as the schedule allows."""
    calibration: str = "emulated-rig"
    """Calibration file, preset, or "emulated-rig": load the tiles on the emulated rig once."""
    auto_tare: bool = True
    """True if a server may update the baseline automatically while the foot is in the air."""
    array: ArraySection = ArraySection()
    tile: Annotated[tuple[TileSection, ...], Field(min_length=1, strict=False)]
    servo: ServoSection | None = None
    reference: ReferenceSection | None = None
    recovery: RecoverySection | None = None
    sync: SyncSection | None = None
    ground: GroundSection = NoGround(kind="none")
    emulation: EmulationSection = EmulationSection()
    fault: tuple[FaultSection, ...] = Field(default=(), strict=False)

    @field_validator("rate_hz")
    @classmethod
    def _rate_can_be_stated(cls, rate_hz: float) -> float:
        if 0.0 < rate_hz < RATE_HZ_MIN:
            raise ValueError(f"is below {RATE_HZ_MIN:g} Hz; 0 is as fast as the schedule allows")
        return rate_hz

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        serials = [tile.serial for tile in self.tile]
        if twice := _find_duplicate(serials):
            raise ValueError(f"tile serial {twice!r} appears twice; every tile has its own")
        plugs = [
            f"address 0x{tile.chip_address:02x} on mux 0x{tile.mux:02x} channel {tile.channel}"
            for tile in self.tile
        ]
        if twice := _find_duplicate(plugs):
            raise ValueError(f"{twice} is used by two tiles; plug each into a channel of its own")
        if all(tile.reference for tile in self.tile):
            raise ValueError("every tile is a reference tile; at least one has to bear load")
        if isinstance(self.ground, MudGround) and self.emulation.temperature_step_k:
            raise ValueError(
                "mud has a temperature step of its own; give ground.temperature_step_k, and leave "
                "emulation.temperature_step_k away"
            )
        for fault in self.fault:
            if fault.tile is not None and fault.tile not in serials:
                raise ValueError(
                    f"a fault names tile {fault.tile!r}, but there are only {', '.join(serials)}"
                )
            if fault.mux is not None and fault.mux not in {tile.mux for tile in self.tile}:
                raise ValueError(f"a fault names mux 0x{fault.mux:02x}, and no tile is behind it")
            if fault.kind in get_args(ServoFault) and self.servo is None:
                raise ValueError(f"{fault.kind} is a fault of the servo, and there is no [servo]")
        return self


def _find_duplicate(values: list[str]) -> str | None:
    return next((value for value, count in Counter(values).items() if count > 1), None)


def list_builtin_scenes() -> tuple[str, ...]:
    """Return the names of the scenes that come with FootTile."""
    folder = resources.files("devices.scene") / "builtin"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.is_file()))


def load_scene(name_or_path: str, chip: str | None = None) -> Scene:
    """Read a built-in scene by its name, or a scene file by its path.

    Args:
        name_or_path: name or path.
        chip: kind of pressure chip of all tiles, instead of the scene's.

    Raises:
        SceneError: no such scene or file, not TOML, an unknown key, a wrong type, a contradiction.
    """
    scene = _read_scene(name_or_path)
    return scene if chip is None else replace_chips(scene, chip)


def _read_scene(name_or_path: str) -> Scene:
    if name_or_path in list_builtin_scenes():
        folder = resources.files("devices.scene") / "builtin"
        text = (folder / f"{name_or_path}.toml").read_text("utf-8")
        return parse_scene(text, where=f"scene {name_or_path}")
    try:
        text = read_text(Path(name_or_path))
    except FileNotFoundError as error:
        raise SceneError(
            f"no file {name_or_path!r} and no built-in scene of this name",
            expected=f"one of {', '.join(list_builtin_scenes())}, or the path of a scene file",
        ) from error
    except (OSError, ValueError) as error:
        raise SceneError(f"scene {name_or_path!r} cannot be read: {error}") from error
    return parse_scene(text, where=name_or_path)


def replace_chips(scene: Scene, chip: str) -> Scene:
    """Return the scene with a kind of pressure chip in all tiles, at its usual address.

    Tiles that have it already stay as they are.

    Raises:
        SceneError: there is no such kind, or two tiles would have one address.
    """
    content = scene.model_dump()
    usual = {"chip": chip, "address": None, "oversampling": 1, "filter": 0, "mode": None}
    content["tile"] = [tile if tile["chip"] == chip else tile | usual for tile in content["tile"]]
    return validate_scene(content, where=f"scene {scene.name} with {chip}")


def parse_scene(text: str, *, where: str) -> Scene:
    """Parse the text of a scene file; `where` names it in errors.

    Raises:
        SceneError: as for `load_scene`.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SceneError(f"not TOML: {error}", where=where) from error
    return validate_scene(content, where=where)


def validate_scene(content: Mapping[str, object], *, where: str) -> Scene:
    """Validate the parsed content of a scene file; `where` names it in errors.

    Raises:
        SceneError: as for `load_scene`.
    """
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        raise SceneError(_format_first_error(error), where=where) from error


def _format_first_error(error: ValidationError) -> str:
    complaint = error.errors()[0]
    key = ".".join(str(part) for part in complaint["loc"]) or "scene"
    message = complaint["msg"].removeprefix("Value error, ")
    if complaint["type"] == "extra_forbidden":
        return f"unknown key {key!r}. Check its spelling, or remove it"
    if complaint["type"] == "missing":
        return f"key {key!r} is missing"
    if complaint["type"] == "value_error" and isinstance(complaint["input"], dict):
        return f"{key}: {message}"
    return f"{key} = {complaint['input']!r}: {message}"
