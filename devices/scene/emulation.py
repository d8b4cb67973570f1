"""Section `[emulation]` of a scene file: what emulated domes and chips show."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from devices.scene.quantities import Kelvin, NotNegative, Section

ReadDuringConversion = Literal["stale", "abort", "torn"]


class EmulationScene(Section):
    """`[emulation]`: which effects the emulated domes and chips show. A real node ignores it."""

    noise_kpa: Annotated[float, Field(ge=0, le=100)] = 0.165
    """Standard deviation of a single reading in all: core, outliers and rounding."""
    correlated_ms: NotNegative = 0.0
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
