"""Scene files: which tiles hang where, what the ground does, and what the estimate needs.

A scene is TOML. Every key is listed here with its unit and default; an unknown key, a wrong type
or a contradiction is a `SceneError` that names the key and the remedy. Built-in scenes are files of
the same form in `devices/scenes/`.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from devices.dynamixel_models import FIRMWARES
from devices.errors import SceneError
from devices.tca9548a import ADDRESSES, CHANNELS

EMULATED = "emulated"
"""Name of a bus or port that is emulated."""

ScheduleName = Literal["simultaneous", "pipelined", "per_mux", "sequential"]
AnySchedule = Literal["auto", ScheduleName]
ReadDuringConversion = Literal["stale", "abort", "torn"]

TileFault = Literal["no_answer", "unplugged", "replaced", "stale", "slow", "all_ones", "over_range"]
MuxFault = Literal["brown_out", "mux_reset"]
BusFault = Literal["sda_low", "sda_high", "scl_low", "adapter_timeout", "nack_storm", "bit_errors"]
FaultKind = Literal[TileFault, MuxFault, BusFault]

RATE = 0.01
"""How often a fault strikes that comes by chance, unless a scene says otherwise."""

BUS = "bus"
"""Target of a fault that is no tile's and no multiplexer's."""

# No quantity here is meant beyond a million; what is, is a slip of the keyboard or of the unit.
_Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
_Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
_Load = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
_Kelvin = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
_GpioLine = Annotated[int, Field(ge=0, le=511)]
_Position = Annotated[float, Field(gt=-1.0, lt=1.0)]  # a tile 50 m away was meant in millimetres


class _Section(BaseModel):
    # Strict: "4" is not 4, and 1 is not true. Only int to float is let through, as in TOML itself.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class ArrayScene(_Section):
    """`[array]`: the bus and how it is asked."""

    bus: str = EMULATED
    """A device such as /dev/i2c-1, or "emulated"."""
    scl_hz: Annotated[float, Field(ge=10_000, le=1_000_000)] = 400_000.0
    """Bus clock of the emulation; on hardware it is set in config.txt. The bounds catch kHz."""
    schedule: AnySchedule = "auto"
    """How the bus is asked (`devices.schedules`); "auto": whatever is best for these tiles."""
    wait_ms: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """How long the driver waits for a conversion. Absent: as long as each part is measured to take
    at start-up. Too short gives stale results."""
    temperature_every: Annotated[int, Field(ge=1, le=1000)] = 1
    """Temperature is read in every so many frames; the others save two bytes a tile."""
    broadcast_channels: Annotated[int, Field(ge=1, le=64)] = 8
    """How many channels may be open at once: the pull-ups of all of them have to be sunk by one
    part (TCA9548A data sheet 9.2.1)."""
    conversion_ms: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Emulation only: conversion time of every part. Absent: drawn for each part."""


class TileScene(_Section):
    """`[[tile]]`: one tile, where it is plugged in and where it sits in the foot frame."""

    serial: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9._-]+$")]
    mux: int
    channel: int
    x_m: _Position
    y_m: _Position
    z_m: _Position
    reference: bool = False
    """A bare tile that measures the surroundings: it bears no load and is in no sum."""

    @field_validator("mux")
    @classmethod
    def _mux_exists(cls, mux: int) -> int:
        if mux not in ADDRESSES:
            raise ValueError(f"0x{mux:02x} is no TCA9548A address, which are 0x70 to 0x77")
        return mux

    @field_validator("channel")
    @classmethod
    def _channel_exists(cls, channel: int) -> int:
        if channel not in CHANNELS:
            raise ValueError(f"{channel} is no channel of a TCA9548A, which are 0 to 7")
        return channel


class ServoScene(_Section):
    """`[servo]`: the Dynamixel whose position goes with the frames."""

    port: str = EMULATED
    """A device such as /dev/ttyUSB0, or "emulated"."""
    model: Literal["MX-28", "MX-64"] = "MX-64"
    protocol: Literal[1, 2] = 2
    """What its firmware speaks; the factory's speaks 1."""
    id: Annotated[int, Field(ge=0)] = 1
    baudrate: Annotated[int, Field(gt=0)] = 1_000_000
    rate_hz: _Positive = 100.0
    """How often the position is read."""
    sign: Literal[-1, 1] = 1
    zero_counts: Annotated[int, Field(ge=-(2**28), le=2**28)] = 2048
    ratio: _Number = 1.0
    """Turns of the segment per turn of the servo."""
    ankle_travel_m_per_rad: _Number | None = None
    """Forward travel of the ankle per radian of the segment; absent: not known."""

    @field_validator("sign", "protocol", mode="before")
    @classmethod
    def _is_a_number(cls, value: object) -> object:
        if isinstance(value, bool):  # true equals 1, and would pass
            raise ValueError(f"{value} is no number")  # noqa: TRY004  # pydantic's
        return value

    @field_validator("id")
    @classmethod
    def _id_exists(cls, servo_id: int, info: ValidationInfo) -> int:
        protocol = info.data.get("protocol", 2)
        highest = FIRMWARES[protocol].protocol.highest_id
        if servo_id > highest:
            raise ValueError(
                f"{servo_id} is no id of a servo with protocol {protocol}, which are 0 to {highest}"
            )
        return servo_id

    @field_validator("ratio")
    @classmethod
    def _ratio_turns_the_segment(cls, ratio: float) -> float:
        if ratio == 0.0:
            raise ValueError("0 would never turn the segment")
        return ratio


class ReferenceScene(_Section):
    """`[reference]`: the force sensor of a calibration rig, read through an MCP3208 on SPI.

    Force is (volts - zero_v) * n_per_v. Neither has a default: nobody knows them but whoever has
    measured this sensor with this amplifier.
    """

    port: str = EMULATED
    """A device such as /dev/spidev0.0, or "emulated"."""
    channel: Annotated[int, Field(ge=0, le=7)] = 0
    """Input of the converter."""
    vref_v: Annotated[float, Field(ge=0.25, le=5.5)] = 3.3
    """Voltage at the converter's VREF, which is its full scale."""
    zero_v: _Number
    """Voltage without a force. At either rail it could not be told from a broken wire."""
    n_per_v: _Number
    """Newtons per volt; negative if a push lowers the voltage."""

    @field_validator("n_per_v")
    @classmethod
    def _a_volt_is_a_force(cls, n_per_v: float) -> float:
        if n_per_v == 0.0:
            raise ValueError("0 would make every voltage 0 N")
        return n_per_v

    @model_validator(mode="after")
    def _zero_can_be_read(self) -> Self:
        if not 0.0 < self.zero_v < self.vref_v:
            raise ValueError(
                f"zero_v = {self.zero_v:g} is not between the rails, 0 and vref_v = "
                f"{self.vref_v:g}; shift the amplifier's output off the rail"
            )
        return self


class RecoveryScene(_Section):
    """`[recovery]`: GPIO lines of a Raspberry Pi that free a stuck bus."""

    gpiochip: str = "/dev/gpiochip0"
    scl_line: _GpioLine = 3
    sda_line: _GpioLine = 2
    reset_line: _GpioLine | None = None
    """RESET of all multiplexers; absent: not wired."""
    i2c_function: Annotated[str, Field(pattern=r"^a[0-8]$")] = "a0"
    """What SDA and SCL are to be again, in words of `pinctrl`; on a Pi 5 "a3"."""

    @model_validator(mode="after")
    def _lines_differ(self) -> Self:
        if len({self.scl_line, self.sda_line, self.reset_line}) < 3:
            raise ValueError("scl_line, sda_line and reset_line have to be different lines")
        return self


class _Ground(_Section):
    pass


class NoGround(_Ground):
    """The foot hangs in the air."""

    kind: Literal["none"]


class PlateGround(_Ground):
    """Somebody stands on a plate and sways."""

    kind: Literal["plate"]
    load_n: _Load = 40.0
    sway_m: _NotNegative = 0.006
    """Amplitude of the centre of pressure's slow sway along the array."""


class RollingGround(_Ground):
    """The paper's rolling rig: a rigid plate passes under the foot's arc at constant speed."""

    kind: Literal["rolling"]
    load_n: _Load = 8.92
    """The paper's leg weighs 0.909 kg."""
    radius_m: _Positive = 0.150
    """Radius of the foot's arc (paper II-D)."""
    speed_m_s: _Positive = 0.02
    patch_m: _Positive = 0.012
    """Half length of the contact patch that the domes' compliance makes of the line contact."""


class IndentationGround(_Ground):
    """The mill: each tile in turn is pressed by a spindle against a reference force sensor."""

    kind: Literal["indentation"]
    load_n: _Load = 30.0
    stroke_s: _Positive = 4.0
    """Duration of one slow loading, and of one unloading."""
    repeats: Annotated[int, Field(ge=2)] = 4
    soak_k: _Kelvin = 4.0
    """Temperature step of the unloaded soak at the end."""


class TraceGround(_Ground):
    """A recorded load, given on the command line with --load."""

    kind: Literal["trace"]


GroundScene = Annotated[
    NoGround | PlateGround | RollingGround | IndentationGround | TraceGround,
    Field(discriminator="kind"),
]


class EmulationScene(_Section):
    """`[emulation]`: which effects the emulated domes and chips show. A real node ignores it."""

    noise_kpa: Annotated[float, Field(ge=0, le=100)] = 0.165
    """Standard deviation of a single reading in all: core, outliers and rounding."""
    correlated_ms: _NotNegative = 0.0
    """Correlation time of the noise's core; 0: white."""
    repeatability: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation of the normalised output between loadings (paper III-A: 0.03)."""
    gas: bool = True
    """Adiabatic overshoot of fast loads."""
    rubber: bool = True
    """Creep of the dome."""
    hysteresis: bool = True
    """Rate-independent loop of the dome."""
    ambient_degc: Annotated[float, Field(gt=-273.15, allow_inf_nan=False)] = 21.0
    temperature_step_k: _Kelvin = 0.0
    """A step of the surroundings' temperature ..."""
    temperature_step_s: _NotNegative = 0.0
    """... this long after power-up. Chip and gas follow with different delays."""
    head_kpa: _NotNegative = 0.0
    """Hydrostatic pressure on the domes ..."""
    head_s: _NotNegative = 0.0
    """... from this long after power-up on."""
    clip_kpa: _NotNegative = 0.0
    """Analogue clip of the chips; 0: none, they wrap (as real parts do)."""
    read_during_conversion: ReadDuringConversion = "stale"
    scl_part: Annotated[float, Field(gt=0, le=4)] = 1.0
    """What the bus clock really is, relative to `array.scl_hz`: 0.625 is the Raspberry Pi whose
    core idles at 250 MHz (hardware.md 3.2)."""


class FaultScene(_Section):
    """`[[fault]]`: something fails `t_s` after the scene began, for `duration_s`.

    At `t_s` = 0 it has failed before the start.
    """

    kind: FaultKind
    tile: str | None = None
    """Which tile; for faults of a tile."""
    mux: int | None = None
    """Which multiplexer; for faults of one."""
    t_s: _NotNegative
    duration_s: _Positive
    rate: Annotated[float, Field(gt=0, le=1)] = RATE
    """How often, for what comes by chance: of the bytes for `nack_storm` and `bit_errors`, of the
    transfers for `adapter_timeout`."""

    @property
    def target(self) -> str:
        """What fails: a tile's serial, a mux as "0x70", or the bus."""
        return self.tile or (BUS if self.mux is None else f"0x{self.mux:02x}")

    @model_validator(mode="after")
    def _names_what_fails(self) -> Self:
        needs_tile, needs_mux = self.kind in get_args(TileFault), self.kind in get_args(MuxFault)
        if needs_tile != (self.tile is not None):
            raise ValueError(f"{self.kind} is {'' if needs_tile else 'no '}fault of a tile")
        if needs_mux != (self.mux is not None):
            raise ValueError(f"{self.kind} is {'' if needs_mux else 'no '}fault of a mux")
        return self


class Scene(_Section):
    """One scene. See the module's text for what a file looks like."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9._-]+$")]
    models: tuple[str, ...] = Field(default=("unwrap", "static"), strict=False)
    """The models that an estimate of this scene needs, in any order."""
    rate_hz: _NotNegative = 0.0
    """Frame rate; 0: as fast as the schedule allows."""
    calibration: str = "bench"
    """A calibration file, a preset's name, or "bench": run the emulated bench once."""
    auto_tare: bool = True
    """May a server that sees the foot in the air let the baseline follow by itself?"""
    array: ArrayScene = ArrayScene()
    tile: Annotated[tuple[TileScene, ...], Field(min_length=1, strict=False)]
    servo: ServoScene | None = None
    reference: ReferenceScene | None = None
    recovery: RecoveryScene | None = None
    ground: GroundScene = NoGround(kind="none")
    emulation: EmulationScene = EmulationScene()
    fault: tuple[FaultScene, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        serials = [tile.serial for tile in self.tile]
        if twice := _repeated(serials):
            raise ValueError(f"tile serial {twice!r} appears twice; every tile has its own")
        plugs = [f"mux 0x{tile.mux:02x} channel {tile.channel}" for tile in self.tile]
        if twice := _repeated(plugs):
            raise ValueError(f"{twice} is used by two tiles; plug each into a channel of its own")
        if all(tile.reference for tile in self.tile):
            raise ValueError("every tile is a reference tile; at least one has to bear load")
        for fault in self.fault:
            if fault.tile is not None and fault.tile not in serials:
                raise ValueError(
                    f"a fault names tile {fault.tile!r}, but there are only {', '.join(serials)}"
                )
            if fault.mux is not None and fault.mux not in {tile.mux for tile in self.tile}:
                raise ValueError(f"a fault names mux 0x{fault.mux:02x}, and no tile is behind it")
        return self


def _repeated(values: list[str]) -> str | None:
    return next((value for value, count in Counter(values).items() if count > 1), None)


def builtin_scenes() -> tuple[str, ...]:
    """Names of the scenes that come with FootTile."""
    folder = resources.files("devices") / "scenes"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.is_file()))


def load_scene(name_or_path: str) -> Scene:
    """Read a built-in scene by its name, or a scene file by its path.

    Raises:
        SceneError: no such scene or file, not TOML, an unknown key, a wrong type, a contradiction.
    """
    if name_or_path in builtin_scenes():
        text = (resources.files("devices") / "scenes" / f"{name_or_path}.toml").read_text("utf-8")
        return parse_scene(text, where=f"scene {name_or_path}")
    try:
        text = Path(name_or_path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"no scene {name_or_path!r}: {error}",
            expected=f"one of {', '.join(builtin_scenes())}, or the path of a scene file",
        ) from error
    return parse_scene(text, where=name_or_path)


def parse_scene(text: str, *, where: str) -> Scene:
    """Build a scene from the text of a scene file; `where` names it in errors.

    Raises:
        SceneError: as for `load_scene`.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SceneError(f"not TOML: {error}", where=where) from error
    return build_scene(content, where=where)


def build_scene(content: Mapping[str, object], *, where: str) -> Scene:
    """Build a scene from what a scene file holds.

    Raises:
        SceneError: as for `load_scene`.
    """
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        raise SceneError(_first_complaint(error), where=where) from error


def _first_complaint(error: ValidationError) -> str:
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
