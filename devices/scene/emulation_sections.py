"""Sections `[ground]`, `[emulation]` and `[[fault]]` of a scene file. A real node ignores them."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from devices.scene.hardware_sections import Kelvin, LoadN, NotNegative, Positive, SceneSection


class NoGround(SceneSection):
    """No ground: the foot hangs in the air."""

    kind: Literal["none"]


class PlateGround(SceneSection):
    """Quiet standing on a plate, with sway."""

    kind: Literal["plate"]
    load_n: LoadN = 40.0
    sway_m: NotNegative = 0.006
    """Amplitude of the centre of pressure's slow sway along the array."""


class RollingGround(SceneSection):
    """The paper's rolling rig: a rigid plate passes under the foot's arc at constant speed."""

    kind: Literal["rolling"]
    load_n: LoadN = 8.92
    """The paper's leg weighs 0.909 kg."""
    radius_m: Positive = 0.150
    """Radius of the foot's arc (paper II-D)."""
    speed_m_s: Positive = 0.02
    patch_m: Positive = 0.012
    """Half length of the contact patch that the domes' compliance makes of the line contact."""


class IndentationGround(SceneSection):
    """Indenter: a spindle presses each tile in turn against a reference force sensor."""

    kind: Literal["indentation"]
    load_n: LoadN = 30.0
    stroke_s: Positive = 4.0
    """Duration of one slow loading, and of one unloading."""
    repeats: Annotated[int, Field(ge=2)] = 4
    soak_k: Kelvin = 4.0
    """Temperature step of the unloaded soak at the end."""


class _HoppingGround(SceneSection):
    """Common keys of soft grounds, on which a leg is dropped and hops three times."""

    mass_kg: Annotated[float, Field(ge=0.3, le=20)] = 0.909
    """Mass of the leg (paper II-D), foot included."""
    drop_m: Annotated[float, Field(ge=0.01, le=0.5)] = 0.10
    """Drop height of the sole above the ground, and height of the hops."""
    leg_n_per_m: Annotated[float, Field(ge=100, le=5_000)] = 600.0
    """Stiffness of the leg."""
    stand_s: Annotated[float, Field(ge=0.2, le=10)] = 0.5
    """Time from touch-down to push-off."""
    pitch_rad: Annotated[float, Field(ge=0, le=0.3)] = 0.1
    """Angle of the segment at take-off; at touch-down its negative."""
    sole_m2: Annotated[float, Field(ge=0.0005, le=0.02)] = 0.004
    """Area of the sole."""
    dome_share: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Part of the sole's area that rests on domes; the rest is the rim."""


class PoppyGround(_HoppingGround):
    """Dry granular ground: loosely packed poppy seeds."""

    kind: Literal["poppy"]
    strength_n_per_cm3: Annotated[float, Field(ge=0.02, le=3)] = 0.3
    """Penetration resistance per depth (Li, Zhang and Goldman 2013: of this order)."""


class MudGround(_HoppingGround):
    """Wet ground: softer, viscous, heavy, cold, with suction."""

    kind: Literal["mud"]
    strength_n_per_cm3: Annotated[float, Field(ge=0.02, le=3)] = 0.15
    """Penetration resistance per depth."""
    viscosity_pa_s: Annotated[float, Field(ge=0, le=100)] = 20.0
    """Viscosity of the mud at the speeds of a hop (assumed; honey has about 10)."""
    suction_kpa: Annotated[float, Field(ge=0, le=50)] = 2.5
    """Largest suction at the sole at lift-off."""
    head_kpa_per_m: Annotated[float, Field(ge=9.8, le=25)] = 16.5
    """Hydrostatic pressure per depth; water's is 9.8."""
    temperature_step_k: Kelvin = -4.0
    """Temperature step of the surroundings at the first contact."""


class TraceGround(SceneSection):
    """Recorded load, given on the command line with --load."""

    kind: Literal["trace"]


GroundSection = Annotated[
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
PartFamily = Literal["default", "broad", "table-1"]
"""Family of emulated parts (`devices.emulation.parts`)."""


class EmulationSection(SceneSection):
    """`[emulation]`: effects of the emulated domes and chips. A real node ignores it."""

    family: PartFamily = "default"
    """Family of domes and chips: the default one, a broad one for unknown real batches, or the
    paper's six domes, each with its name as serial."""
    noise_kpa: Annotated[float, Field(ge=0, le=100)] = 0.165
    """Standard deviation of a single reading of an MPL115A2: core noise, outliers and rounding."""
    correlated_ms: NotNegative = 0.0
    """Correlation time of the noise's core; 0: white."""
    repeatability: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation of the normalised output between loadings (paper III-A: 0.03)."""
    gain_drift: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """Largest relative change of each dome's gain since its calibration, up or down: rubber ages,
    and stiffens in the cold. It is constant within a session."""
    gas: bool = True
    """Adiabatic overshoot of fast loads."""
    rubber: bool = True
    """Creep of the dome."""
    hysteresis: bool = True
    """Rate-independent loop of the dome."""
    ambient_degc: Annotated[float, Field(gt=-273.15, allow_inf_nan=False)] = 21.0
    ambient_kpa: Annotated[float, Field(ge=50, le=115)] | None = None
    """Atmospheric pressure, which affects only a reference tile. Absent: an ordinary day's, drawn
    from 99 to 101."""
    temperature_step_k: Kelvin = 0.0
    """Step of the surroundings' temperature."""
    temperature_step_s: NotNegative = 0.0
    """Time of the step after power-up. Chip and gas follow with different delays."""
    head_kpa: NotNegative = 0.0
    """Hydrostatic pressure on the domes, from `head_s` on."""
    head_s: NotNegative = 0.0
    """Begin of the hydrostatic pressure, after power-up."""
    clip_kpa: NotNegative = 0.0
    """Analogue clipping pressure of the chips; 0: none, an MPL115A2 wraps (as real parts do)."""
    read_during_conversion: ReadDuringConversion = "stale"
    scl_part: Annotated[float, Field(gt=0, le=4)] = 1.0
    """Real bus clock relative to `array.scl_hz`: 0.625 for a Raspberry Pi whose core idles at
    250 MHz (hardware.md 3.2)."""


PartFault = Literal["no_answer", "unplugged", "replaced", "stale", "slow", "all_ones"]
"""Faults of a tile at its registers."""
SenseFault = Literal["over_range", "frozen", "puncture"]
"""Faults of a tile before conversion: dome or transducer."""
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

DEFAULT_LEAK_S = 2.0
"""Default time constant of a punctured dome's leak."""

DEFAULT_FAULT_RATE = 0.01
"""Default probability of a random fault."""

BUS_TARGET = "bus"
"""Target of a fault of the bus or of the servo."""


class FaultSection(SceneSection):
    """`[[fault]]`: fault that begins `t_s` after the scene's begin and lasts `compute_duration_s`.

    With `t_s` = 0 the fault exists before the start.
    """

    kind: FaultKind
    tile: str | None = None
    """Serial of the tile; for faults of a tile."""
    mux: int | None = None
    """Address of the multiplexer; for faults of one."""
    t_s: NotNegative
    duration_s: Positive
    rate: Annotated[float, Field(gt=0, le=1)] = DEFAULT_FAULT_RATE
    """Probability of a random fault: per byte for `nack_storm` and `bit_errors`, per transfer for
    `adapter_timeout`."""
    leak_s: Positive = DEFAULT_LEAK_S
    """Time constant of a `puncture`: the pressure difference falls to 1/e."""

    @property
    def target(self) -> str:
        """Faulty part: a tile's serial, a mux as "0x70", or the bus."""
        return self.tile or (BUS_TARGET if self.mux is None else f"0x{self.mux:02x}")

    @model_validator(mode="after")
    def _names_what_fails(self) -> Self:
        needs_tile, needs_mux = self.kind in get_args(TileFault), self.kind in get_args(MuxFault)
        if needs_tile != (self.tile is not None):
            raise ValueError(f"{self.kind} is {'' if needs_tile else 'no '}fault of a tile")
        if needs_mux != (self.mux is not None):
            raise ValueError(f"{self.kind} is {'' if needs_mux else 'no '}fault of a mux")
        return self
