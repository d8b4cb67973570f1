"""Sections of a scene file for the hardware: bus, tiles, servo, reference force, recovery lines."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from devices.chips.dynamixel.protocol import FIRMWARES
from devices.chips.pressure_chip import ChipSettings, Registers
from devices.chips.pressure_chips import PRESSURE_CHIPS
from devices.chips.tca9548a import ADDRESSES, CHANNELS
from devices.errors import UsageError
from devices.types import Identifier

# A quantity beyond a million is a typing error or a wrong unit.
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
LoadN = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
Kelvin = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
GpioLineNumber = Annotated[int, Field(ge=0, le=511)]
Name = Annotated[Identifier, Field(min_length=1, pattern=r"^[A-Za-z0-9._-]+$")]
Position = Annotated[float, Field(gt=-1.0, lt=1.0)]  # a tile 50 m away was meant in millimetres


class SceneSection(BaseModel):
    """Base class of the sections of a scene file."""

    # Strict: "4" is not 4, and 1 is not true. Only int to float is converted, as in TOML itself.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


EMULATED = "emulated"
"""Name of an emulated bus or port."""

ScheduleName = Literal["simultaneous", "pipelined", "per_mux", "sequential"]
AnySchedule = Literal["auto", ScheduleName]


class ArraySection(SceneSection):
    """`[array]`: the bus and its schedule."""

    bus: str = EMULATED
    """Device such as /dev/i2c-1, a USB adapter such as usb:1c40:0534, or "emulated"."""
    scl_hz: Annotated[float, Field(ge=10_000, le=1_000_000)] = 400_000.0
    """Bus clock of the emulation; on hardware it is set in config.txt. The bounds catch kHz."""
    schedule: AnySchedule = "auto"
    """Order of transfers (`devices.array.schedules`); "auto": the best for these tiles."""
    wait_ms: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Wait of the driver for a conversion. Absent: each part's conversion time, measured at
    start-up. Too short a wait gives stale results."""
    temperature_every: Annotated[int, Field(ge=1, le=1000)] = 1
    """Interval in frames at which temperature is read; other frames save two bytes a tile."""
    broadcast_channels: Annotated[int, Field(ge=1, le=64)] = 8
    """Largest number of channels open at once: one part has to sink the current of all pull-ups
    (TCA9548A data sheet 9.2.1)."""
    conversion_ms: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Emulation only: conversion time of every part. Absent: drawn for each part."""


class TileSection(SceneSection):
    """`[[tile]]`: a tile, its mux channel and its position in the foot frame."""

    serial: Name
    mux: int
    channel: int
    x_m: Position
    y_m: Position
    z_m: Position
    reference: bool = False
    """True for a bare tile that measures the surroundings: no load, excluded from all sums."""
    chip: str = "mpl115a2"
    """Kind of pressure chip."""
    address: int | None = None
    """Its I2C address; absent: the usual one of its kind."""

    oversampling: int = 1
    """Number of samples that the chip takes of a pressure; more are less noisy and slower."""
    filter: int = 0
    """Coefficient of the chip's own low-pass; 0: none, as the estimator filters better."""
    mode: Literal["continuous", "forced"] | None = None
    """Conversions that the chip starts by itself, or on command; absent: as is usual for it."""

    @property
    def chip_settings(self) -> Registers:
        """Its chip's settings, as its driver writes them."""
        return PRESSURE_CHIPS[self.chip].encode_settings(self._settings)

    @property
    def _settings(self) -> ChipSettings:
        return ChipSettings(self.oversampling, self.filter, self.mode)

    @property
    def chip_address(self) -> int:
        """I2C address of its chip."""
        return PRESSURE_CHIPS[self.chip].addresses[0] if self.address is None else self.address

    @field_validator("chip")
    @classmethod
    def _chip_is_known(cls, chip: str) -> str:
        if chip not in PRESSURE_CHIPS:
            raise ValueError(f"is no kind of chip, which are {', '.join(PRESSURE_CHIPS)}")
        return chip

    @model_validator(mode="after")
    def _address_and_settings_are_the_chips(self) -> Self:
        addresses = PRESSURE_CHIPS[self.chip].addresses
        if self.chip_address not in addresses:
            known = ", ".join(f"0x{address:02x}" for address in addresses)
            raise ValueError(f"address 0x{self.chip_address:02x} is none of {self.chip}: {known}")
        try:
            PRESSURE_CHIPS[self.chip].encode_settings(self._settings)
        except UsageError as error:
            raise ValueError(str(error)) from error
        return self

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


class ServoSection(SceneSection):
    """`[servo]`: the Dynamixel servo whose position is stored with the frames."""

    port: str = EMULATED
    """Device such as /dev/ttyUSB0, or "emulated"."""
    model: Literal["MX-28", "MX-64"] = "MX-64"
    protocol: Literal[1, 2] = 2
    """Protocol version of its firmware; the factory's is 1."""
    id: Annotated[int, Field(ge=0)] = 1
    baudrate: Annotated[int, Field(gt=0)] = 1_000_000
    rate_hz: Positive = 100.0
    """Rate at which the position is read."""
    sign: Literal[-1, 1] = 1
    zero_counts: Annotated[int, Field(ge=-(2**28), le=2**28)] = 2048
    ratio: Number = 1.0
    """Turns of the segment per turn of the servo."""
    ankle_travel_m_per_rad: Number | None = None
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
        highest = FIRMWARES[protocol].protocol.max_servo_id
        if servo_id > highest:
            raise ValueError(
                f"{servo_id} is no servo id of protocol {protocol}; expected 0 to {highest}"
            )
        return servo_id

    @field_validator("ratio")
    @classmethod
    def _ratio_turns_the_segment(cls, ratio: float) -> float:
        if ratio == 0.0:
            raise ValueError("0 would never turn the segment")
        return ratio


class ReferenceSection(SceneSection):
    """`[reference]`: the force sensor of a calibration rig, read through an MCP3208 on SPI.

    Force is (volts - zero_v) * n_per_v. Neither has a default: both have to be measured with this
    sensor and amplifier.
    """

    port: str = EMULATED
    """Device such as /dev/spidev0.0, or "emulated"."""
    channel: Annotated[int, Field(ge=0, le=7)] = 0
    """Input of the converter."""
    vref_v: Annotated[float, Field(ge=0.25, le=5.5)] = 3.3
    """Voltage at the converter's VREF: its full scale."""
    zero_v: Number
    """Voltage without a force. It must be off the rails, to differ from a broken wire."""
    n_per_v: Number
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


class RecoverySection(SceneSection):
    """`[recovery]`: GPIO lines of a Raspberry Pi that free a stuck bus."""

    gpiochip: str = "/dev/gpiochip0"
    scl_line: GpioLineNumber = 3
    sda_line: GpioLineNumber = 2
    reset_line: GpioLineNumber | None = None
    """RESET of all multiplexers; absent: not wired."""
    i2c_function: Annotated[str, Field(pattern=r"^a[0-8]$")] = "a0"
    """Pin function of SDA and SCL to restore, as named by `pinctrl`; "a3" on a Pi 5."""

    @model_validator(mode="after")
    def _lines_differ(self) -> Self:
        if len({self.scl_line, self.sda_line, self.reset_line}) < 3:
            raise ValueError("scl_line, sda_line and reset_line have to be different lines")
        return self


class SyncSection(SceneSection):
    """`[sync]`: TTL lines of a Raspberry Pi: edges that become markers, and a recording signal."""

    gpiochip: str = "/dev/gpiochip0"
    input_line: GpioLineNumber | None = None
    """Line whose edges become markers; absent: not wired."""
    edge: Literal["rising", "falling", "both"] = "rising"
    label: Name = "sync"
    """Label of the markers; with `edge = "both"` the edge's direction follows it."""
    bias: Literal["as_is", "disabled", "pull_up", "pull_down"] = "as_is"
    debounce_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Time for which a level has to last, us. The kernel then stamps the edge that much later."""
    output_line: GpioLineNumber | None = None
    """Line that is high, or blinks the code, while a session is recorded; absent: not wired."""
    output: Literal["recording", "code"] = "recording"
    """Signal meanwhile: high, or the code of a lamp that films show (`devices.lamp_code`)."""

    @property
    def bound_ns(self) -> int:
        """Bound of the error of an edge's time stamp: interrupt latency, and the debouncing.

        The latency is assumed, not measured. A debounced edge is stamped at a tick of the kernel,
        of up to 10 ms, after that time.
        """
        return 200_000 + (1000 * self.debounce_us + 10_000_000 if self.debounce_us else 0)

    @model_validator(mode="after")
    def _lines_are_named_and_differ(self) -> Self:
        if self.input_line == self.output_line:
            raise ValueError(
                "names no line, or one line twice; give input_line, output_line or both"
            )
        return self
