"""Section `[ground]` of a scene file: what the emulated foot stands on. A real node ignores it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

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
