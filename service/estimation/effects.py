"""Effects of a dome beside its static curve: gas, rubber, hysteresis, temperature.

Every parameter has its 95 % interval. A recording may not determine an effect: its model is then
not offered for that tile, and `refused` has the reason.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from devices.arrays import Floats
from devices.types import StrictModel, Text

WALL_PER_KPA = 0.00124
"""Compliance of the wall, part of the bubble's volume for a kPa: elastic estimate for Vytaflex 60
(hardware.md 9), used without a thermal soak at two temperatures."""

MISFIT_MIN = 0.1
"""Least misfit of a correction, however well it fits the rig: a single time constant stands for a
sphere's many, two terms for a spectrum, three plays for a continuum."""

EffectName = Literal["temperature", "ambient", "gas", "rubber", "hysteresis"]


_NUMBER_MAX = 1e12
"""Bound beyond every quantity here, whose sums, products and cubes do not overflow."""
Number = Annotated[float, Field(ge=-_NUMBER_MAX, le=_NUMBER_MAX)]
NonNegative = Annotated[float, Field(ge=0, le=_NUMBER_MAX)]
TERMS_MAX = 32
TermLimit = Field(max_length=TERMS_MAX)
"""Bound of the number of terms of a model."""


class CalibrationPart(StrictModel):
    """Base of the parts of a calibration file."""


class Parameter(CalibrationPart):
    """Fitted value with its standard uncertainty."""

    value: Number
    sigma: NonNegative

    @property
    def interval_95(self) -> tuple[float, float]:
        """95 % interval."""
        return self.value - 1.96 * self.sigma, self.value + 1.96 * self.sigma


def parameter_values(parameters: Iterable[Parameter]) -> Floats:
    """Return the values of parameters without their uncertainties, (n,)."""
    return np.array([parameter.value for parameter in parameters])


GAMMA_MAX = 5.0 / 3.0
"""Largest ratio of heat capacities of any gas, that of single atoms."""


class GasEffect(CalibrationPart):
    """Parameters of the model `gas`."""

    gamma: Parameter
    tau_s: Parameter
    misfit: NonNegative
    """Part of the correction that the test rig shows to be wrong, root mean square."""

    @model_validator(mode="after")
    def _check_invertible(self) -> Self:
        if not (1.0 <= self.gamma.value <= GAMMA_MAX and self.tau_s.value > 0.0):
            raise ValueError("a gas has a gamma of 1 to 5/3 and a tau above 0")
        return self


class RubberEffect(CalibrationPart):
    """Parameters of the model `rubber`, with the curve of settled forces, beneath creep and loop.

    Curve as in `TileCalibration`, in the same variable and units.
    """

    part: Annotated[tuple[Parameter, ...], TermLimit]
    tau_s: Annotated[tuple[Parameter, ...], TermLimit]
    coefficients: tuple[Number, Number, Number, Number]
    covariance: tuple[tuple[Number, ...], ...]
    scatter: NonNegative
    """Standard deviation of a new loading's gauge pressure, relative."""
    misfit: NonNegative
    """Part of the correction that the test rig shows to be wrong, root mean square."""
    curve_misfit_n: NonNegative
    """Root mean square misfit of the cubic where slow strokes agree with one another."""

    @model_validator(mode="after")
    def _check_invertible(self) -> Self:
        if len(self.part) != len(self.tau_s) or not all(tau.value > 0.0 for tau in self.tau_s):
            raise ValueError("every creeping part has a time above 0")
        _check_fractions("creeping parts", self.part)
        return self


FLOW_FRACTION_MAX = 0.4
"""Largest part of a change of force for which the inversion always converges."""
FLOW_EXPONENT_RANGE = (1.5, 10.0)
"""Range of the flow's exponent: from nearly an exponential to nearly a play."""
FLOW_STRESS_MIN_N = 0.01
"""Least stress of a branch that a recording shows."""


class FlowEffect(CalibrationPart):
    """Parameters of the viscous branch of the model `hysteresis`."""

    part: Parameter
    """Part of a change of force that the branch carries at first."""
    stress_n: Parameter
    """Force on the branch during a slow stroke."""
    power: Parameter
    """Exponent of the flow over the force on the branch."""

    @model_validator(mode="after")
    def _check_invertible(self) -> Self:
        if not (
            0.0 <= self.part.value <= FLOW_FRACTION_MAX and self.stress_n.value >= FLOW_STRESS_MIN_N
        ):
            raise ValueError(
                f"a branch that flows has a part of 0 to {FLOW_FRACTION_MAX:g} and bears "
                f"{FLOW_STRESS_MIN_N:g} N or more"
            )
        least, most = FLOW_EXPONENT_RANGE
        if not least <= self.power.value <= most:
            raise ValueError(f"a branch flows with a power of {least:g} to {most:g}")
        return self


class HysteresisEffect(CalibrationPart):
    """Parameters of the model `hysteresis`: weights of its plays, and a viscous branch or None."""

    part: Annotated[tuple[Parameter, ...], TermLimit]
    flow: FlowEffect | None = None

    @model_validator(mode="after")
    def _check_invertible(self) -> Self:
        _check_fractions("parts of the plays", self.part)
        return self


class TemperatureEffect(CalibrationPart):
    """Parameters of the model `temperature`; `ambient` needs the wall's compliance."""

    kpa_per_k: Parameter
    """Rise of the baseline with the gas' temperature."""
    lag_s: Parameter
    """Lag of the gas behind its chip; negative where the chip lags."""
    wall_per_kpa: Parameter
    """Compliance of the wall, part of the volume for a kPa, from the rise's deficit below p/T."""

    @model_validator(mode="after")
    def _check_invertible(self) -> Self:
        if not self.kpa_per_k.value > 0.0:
            raise ValueError("a sealed gas has a rise per kelvin above 0")
        return self


SAMPLE_DELAY_MAX_S = 60.0
"""Largest delay of a sample, so that instants fit into 64 bits."""


class Effects(CalibrationPart):
    """Effects that the recordings determined; None otherwise, with the reason in `refused`."""

    gas: GasEffect | None = None
    rubber: RubberEffect | None = None
    hysteresis: HysteresisEffect | None = None
    temperature: TemperatureEffect | None = None
    late_s: Parameter | None = None
    """Delay of the tile's samples behind the instants in its frames: the data sheet does not say
    where in a conversion the chip samples. None: not determined, for want of fast loads."""
    late_common_s: NonNegative = 0.0
    """Standard uncertainty that all tiles' `late_s` share, by the reference's own delay."""
    reference_late_s: Number = 0.0
    """Assumed delay of the reference; the rig measured the sum of `late_s` and this."""
    at_bound: Annotated[tuple[Text, ...], TermLimit] = ()
    """Parameters at a bound."""
    refused: dict[EffectName, Text] = Field(default={})

    @model_validator(mode="after")
    def _check_sample_delay(self) -> Self:
        if self.late_s is not None and abs(self.late_s.value) > SAMPLE_DELAY_MAX_S:
            raise ValueError(f"a tile is sampled {SAMPLE_DELAY_MAX_S:g} s from its frame at most")
        return self

    @property
    def wall_compliance_or_default_per_kpa(self) -> float:
        """Compliance of the wall per kPa from the thermal soak, else the default `WALL_PER_KPA`."""
        return WALL_PER_KPA if self.temperature is None else self.temperature.wall_per_kpa.value


def _check_fractions(what: str, parts: tuple[Parameter, ...]) -> None:
    if not all(part.value >= 0.0 for part in parts) or sum(part.value for part in parts) >= 1.0:
        raise ValueError(f"{what} are 0 or more, and in sum below 1: else no force follows")
