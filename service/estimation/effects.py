"""What a bench recording shows of a tile beside its static curve: gas, rubber, hysteresis, warmth.

Every parameter stands with its 95 % interval. What a recording does not determine is not here: the
model that needs it is not offered for that tile, and `refused` says why.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from devices.arrays import Floats
from devices.facts import Facts, Text

WALL_PER_KPA = 0.00124
"""Part of the bubble's volume that the wall gives way for a kPa: elastic estimate for Vytaflex 60
(hardware.md 9), where a soak at two temperatures does not tell."""

MISFIT_MIN = 0.1
"""No correction is better than this, however well it fits a bench: a single time stands for a
sphere's many, two terms for a spectrum, three plays for a continuum."""

EffectName = Literal["temperature", "ambient", "gas", "rubber", "hysteresis"]


_MOST = 1e12
"""Far beyond every quantity here, and near enough that no sum, product or cube overflows."""
Number = Annotated[float, Field(ge=-_MOST, le=_MOST)]
NotNegative = Annotated[float, Field(ge=0, le=_MOST)]
PARTS_MAX = 32
Some = Field(max_length=PARTS_MAX)
"""Of parts that a model has some of."""


class CalibrationPart(Facts):
    """A part of a calibration file."""


class Parameter(CalibrationPart):
    """A fitted value and its standard uncertainty."""

    value: Number
    sigma: NotNegative

    @property
    def interval_95(self) -> tuple[float, float]:
        """Interval that holds it in 95 of 100 cases."""
        return self.value - 1.96 * self.sigma, self.value + 1.96 * self.sigma


def values(parameters: Iterable[Parameter]) -> Floats:
    """Values without their uncertainties, (n,)."""
    return np.array([parameter.value for parameter in parameters])


GAMMA_MOST = 5.0 / 3.0
"""Of one atom: no gas has a greater ratio of heat capacities."""


class GasEffect(CalibrationPart):
    """Of the model `gas`."""

    gamma: Parameter
    tau_s: Parameter
    misfit: NotNegative
    """Part of the correction that the bench shows to be wrong, root mean square."""

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        if not (1.0 <= self.gamma.value <= GAMMA_MOST and self.tau_s.value > 0.0):
            raise ValueError("a gas has a gamma of 1 to 5/3 and a tau above 0")
        return self


class RubberEffect(CalibrationPart):
    """Of the model `rubber`, with the curve of forces that have lasted, beneath creep and loop.

    Curve as in `TileCalibration`, in the same variable and units.
    """

    part: Annotated[tuple[Parameter, ...], Some]
    tau_s: Annotated[tuple[Parameter, ...], Some]
    coefficients: tuple[Number, Number, Number, Number]
    covariance: tuple[tuple[Number, ...], ...]
    scatter: NotNegative
    """Standard deviation of a new loading's gauge pressure, relative."""
    misfit: NotNegative
    """Part of the correction that the bench shows to be wrong, root mean square."""
    curve_misfit_n: NotNegative
    """How far a cubic is off where slow strokes agree with one another, root mean square."""

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        if len(self.part) != len(self.tau_s) or not all(tau.value > 0.0 for tau in self.tau_s):
            raise ValueError("every creeping part has a time above 0")
        _leave_something("creeping parts", self.part)
        return self


PART_MOST = 0.4
"""Of a change of force: up to here the force is found from what appears of it, come what may."""
POWERS = (1.5, 10.0)
"""Of the flow: from nearly an exponential to nearly a play."""
STRESS_LEAST_N = 0.01
"""What bears less is not seen."""


class FlowEffect(CalibrationPart):
    """Of the model `hysteresis`: its branch that flows."""

    part: Parameter
    """Of a change of force, that the branch bears at first."""
    stress_n: Parameter
    """What it bears of a force that changes as in a slow stroke."""
    power: Parameter
    """Of its flow over what it bears."""

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        if not (0.0 <= self.part.value <= PART_MOST and self.stress_n.value >= STRESS_LEAST_N):
            raise ValueError(
                f"a branch that flows has a part of 0 to {PART_MOST:g} and bears "
                f"{STRESS_LEAST_N:g} N or more"
            )
        least, most = POWERS
        if not least <= self.power.value <= most:
            raise ValueError(f"a branch flows with a power of {least:g} to {most:g}")
        return self


class HysteresisEffect(CalibrationPart):
    """Of the model `hysteresis`: parts of its plays, and the branch that flows; None: none does."""

    part: Annotated[tuple[Parameter, ...], Some]
    flow: FlowEffect | None = None

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        _leave_something("parts of the plays", self.part)
        return self

    @model_serializer(mode="wrap")
    def _without_a_branch_as_before(self, written: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A branch that is not there is not written: the ids of older calibrations stay theirs."""
        content: dict[str, Any] = written(self)
        if self.flow is None:
            content.pop("flow", None)
        return content


class TemperatureEffect(CalibrationPart):
    """Of the model `temperature`, and of `ambient`, which needs the wall's give."""

    kpa_per_k: Parameter
    """Rise of the baseline with the gas' temperature."""
    lag_s: Parameter
    """How long the gas is behind its chip; negative where the chip is behind its gas."""
    wall_per_kpa: Parameter
    """Part of the volume that the wall gives way for a kPa, by how much less than p/T it is."""

    @model_validator(mode="after")
    def _can_be_undone(self) -> Self:
        if not self.kpa_per_k.value > 0.0:
            raise ValueError("a sealed gas has a rise per kelvin above 0")
        return self


LATE_MOST_S = 60.0
"""Nor does any frame take longer; and instants, in nanoseconds, have 64 bits."""


class Effects(CalibrationPart):
    """All that the recording determined; None otherwise, and `refused` says why."""

    gas: GasEffect | None = None
    rubber: RubberEffect | None = None
    hysteresis: HysteresisEffect | None = None
    temperature: TemperatureEffect | None = None
    late_s: Parameter | None = None
    """How much later the tile is sampled than its frames say: where in a conversion the chip does
    so is not documented. None: no fast loads told."""
    late_common_s: NotNegative = 0.0
    """Standard uncertainty that all tiles' `late_s` share: that of the reference's own delay."""
    reference_late_s: Number = 0.0
    """How late the reference was taken to be: the bench saw the tile later by `late_s` and that."""
    at_bound: Annotated[tuple[Text, ...], Some] = ()
    """Parameters that were found at the end of what is possible."""
    refused: dict[EffectName, Text] = Field(default={})

    @model_validator(mode="after")
    def _is_read_in_its_frame(self) -> Self:
        if self.late_s is not None and abs(self.late_s.value) > LATE_MOST_S:
            raise ValueError(f"a tile is sampled {LATE_MOST_S:g} s from its frame at most")
        return self

    @property
    def wall_per_kpa(self) -> float:
        """As measured in the soak, else the estimate for the material."""
        return WALL_PER_KPA if self.temperature is None else self.temperature.wall_per_kpa.value


def _leave_something(what: str, parts: tuple[Parameter, ...]) -> None:
    if not all(part.value >= 0.0 for part in parts) or sum(part.value for part in parts) >= 1.0:
        raise ValueError(f"{what} are 0 or more, and in sum below 1: else no force follows")
