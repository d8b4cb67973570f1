"""Section `[ground]` of a scene file: what the emulated foot stands on. A real node ignores it."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from devices.scene.quantities import Kelvin, LoadN, NotNegative, Positive, Section


class NoGround(Section):
    """The foot hangs in the air."""

    kind: Literal["none"]


class PlateGround(Section):
    """Quiet standing on a plate, with sway."""

    kind: Literal["plate"]
    load_n: LoadN = 40.0
    sway_m: NotNegative = 0.006
    """Amplitude of the centre of pressure's slow sway along the array."""


class RollingGround(Section):
    """The paper's rolling rig: a rigid plate passes under the foot's arc at constant speed."""

    kind: Literal["rolling"]
    load_n: LoadN = 8.92
    """The paper's leg weighs 0.909 kg."""
    radius_m: Positive = 0.150
    """Radius of the foot's arc (paper II-D)."""
    speed_m_s: Positive = 0.02
    patch_m: Positive = 0.012
    """Half length of the contact patch that the domes' compliance makes of the line contact."""


class IndentationGround(Section):
    """The mill: each tile in turn is pressed by a spindle against a reference force sensor."""

    kind: Literal["indentation"]
    load_n: LoadN = 30.0
    stroke_s: Positive = 4.0
    """Duration of one slow loading, and of one unloading."""
    repeats: Annotated[int, Field(ge=2)] = 4
    soak_k: Kelvin = 4.0
    """Temperature step of the unloaded soak at the end."""


class _HoppingGround(Section):
    """A leg is dropped on soft ground and hops three times: what both grounds have in common."""

    mass_kg: Annotated[float, Field(ge=0.3, le=20)] = 0.909
    """Mass of the leg (paper II-D), foot included."""
    drop_m: Annotated[float, Field(ge=0.01, le=0.5)] = 0.10
    """Height of the sole above the ground when it is dropped, and how high it hops."""
    leg_n_per_m: Annotated[float, Field(ge=100, le=5_000)] = 600.0
    """Stiffness of the leg."""
    stand_s: Annotated[float, Field(ge=0.2, le=10)] = 0.5
    """From touch-down to push-off."""
    pitch_rad: Annotated[float, Field(ge=0, le=0.3)] = 0.1
    """Angle of the segment at take-off, and the negative one at touch-down."""
    sole_m2: Annotated[float, Field(ge=0.0005, le=0.02)] = 0.004
    """Area of the sole."""
    dome_share: Annotated[float, Field(gt=0, le=1)] = 0.8
    """How much of that area rests on domes; the rest is the sole's rim."""


class PoppyGround(_HoppingGround):
    """Dry granular ground: loosely packed poppy seeds."""

    kind: Literal["poppy"]
    strength_n_per_cm3: Annotated[float, Field(ge=0.02, le=3)] = 0.3
    """Stress against sinking in per depth (Li, Zhang and Goldman 2013: of this order)."""


class MudGround(_HoppingGround):
    """Wet ground: softer, viscous, heavy, cold, and it sucks."""

    kind: Literal["mud"]
    strength_n_per_cm3: Annotated[float, Field(ge=0.02, le=3)] = 0.15
    """Stress against sinking in per depth."""
    viscosity_pa_s: Annotated[float, Field(ge=0, le=100)] = 20.0
    """Of the mud at the speeds of a hop (assumed; honey has about 10)."""
    suction_kpa: Annotated[float, Field(ge=0, le=50)] = 2.5
    """The most that sucks at the sole at lift-off."""
    head_kpa_per_m: Annotated[float, Field(ge=9.8, le=25)] = 16.5
    """Hydrostatic pressure per depth; water's is 9.8."""
    temperature_step_k: Kelvin = -4.0
    """Of the surroundings, when the foot first touches it."""


class TraceGround(Section):
    """A recorded load, given on the command line with --load."""

    kind: Literal["trace"]


GroundScene = Annotated[
    NoGround
    | PlateGround
    | RollingGround
    | PoppyGround
    | MudGround
    | IndentationGround
    | TraceGround,
    Field(discriminator="kind"),
]


ReadDuringConversion = Literal["stale", "abort", "torn"]
Family = Literal["default", "broad", "table-1"]
"""Of emulated parts; drawn in `devices.emulation.families`."""


class EmulationScene(Section):
    """`[emulation]`: which effects the emulated domes and chips show. A real node ignores it."""

    family: Family = "default"
    """Which domes and chips are drawn: the usual ones, whatever a real batch may be, or the paper's
    six domes, each by its name as serial."""
    noise_kpa: Annotated[float, Field(ge=0, le=100)] = 0.165
    """Standard deviation of a single reading in all: core, outliers and rounding."""
    correlated_ms: NotNegative = 0.0
    """Correlation time of the noise's core; 0: white."""
    repeatability: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation of the normalised output between loadings (paper III-A: 0.03)."""
    gain_drift: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """How much each dome's gain has changed since its bench, up or down, at the most: rubber ages,
    and stiffens in the cold. Within a session it is constant."""
    gas: bool = True
    """Adiabatic overshoot of fast loads."""
    rubber: bool = True
    """Creep of the dome."""
    hysteresis: bool = True
    """Rate-independent loop of the dome."""
    ambient_degc: Annotated[float, Field(gt=-273.15, allow_inf_nan=False)] = 21.0
    ambient_kpa: Annotated[float, Field(ge=50, le=115)] | None = None
    """Pressure of the atmosphere, which only a reference tile feels: the chip's range. Absent: an
    ordinary day's, drawn from 99 to 101."""
    temperature_step_k: Kelvin = 0.0
    """A step of the surroundings' temperature ..."""
    temperature_step_s: NotNegative = 0.0
    """... this long after power-up. Chip and gas follow with different delays."""
    head_kpa: NotNegative = 0.0
    """Hydrostatic pressure on the domes ..."""
    head_s: NotNegative = 0.0
    """... from this long after power-up on."""
    clip_kpa: NotNegative = 0.0
    """Analogue clip of the chips; 0: none, they wrap (as real parts do)."""
    read_during_conversion: ReadDuringConversion = "stale"
    scl_part: Annotated[float, Field(gt=0, le=4)] = 1.0
    """What the bus clock really is, relative to `array.scl_hz`: 0.625 is the Raspberry Pi whose
    core idles at 250 MHz (hardware.md 3.2)."""


PartFault = Literal["no_answer", "unplugged", "replaced", "stale", "slow", "all_ones"]
"""Of a tile, at its registers."""
SenseFault = Literal["over_range", "frozen", "puncture"]
"""Of a tile, before its registers: what is converted is wrong already."""
TileFault = Literal[PartFault, SenseFault]
MuxFault = Literal["brown_out", "mux_reset"]
BusFault = Literal[
    "sda_low",
    "sda_high",
    "scl_low",
    "adapter_timeout",
    "adapter_unplugged",
    "nack_storm",
    "bit_errors",
]
ServoFault = Literal["servo_unplugged", "servo_restart"]
FaultKind = Literal[TileFault, MuxFault, BusFault, ServoFault]

LEAK_S = 2.0
"""How long a punctured dome takes to even out, unless a scene says otherwise."""

RATE = 0.01
"""How often a fault strikes that comes by chance, unless a scene says otherwise."""

BUS = "bus"
"""Target of a fault that is no tile's and no multiplexer's: of the bus, or of the servo."""


class FaultScene(Section):
    """`[[fault]]`: something fails `t_s` after the scene began, for `duration_s`.

    At `t_s` = 0 it has failed before the start.
    """

    kind: FaultKind
    tile: str | None = None
    """Which tile; for faults of a tile."""
    mux: int | None = None
    """Which multiplexer; for faults of one."""
    t_s: NotNegative
    duration_s: Positive
    rate: Annotated[float, Field(gt=0, le=1)] = RATE
    """How often, for what comes by chance: of the bytes for `nack_storm` and `bit_errors`, of the
    transfers for `adapter_timeout`."""
    leak_s: Positive = LEAK_S
    """Of a `puncture`: in this time its pressure difference falls to 1/e."""

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
