"""Section `[ground]` of a scene file: what the emulated foot stands on. A real node ignores it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from devices.scene_quantities import Kelvin, LoadN, NotNegative, Positive, Section


class NoGround(Section):
    """The foot hangs in the air."""

    kind: Literal["none"]


class PlateGround(Section):
    """Somebody stands on a plate and sways."""

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


class TraceGround(Section):
    """A recorded load, given on the command line with --load."""

    kind: Literal["trace"]


GroundScene = Annotated[
    NoGround | PlateGround | RollingGround | IndentationGround | TraceGround,
    Field(discriminator="kind"),
]
