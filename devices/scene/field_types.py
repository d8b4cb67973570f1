"""Field types of scene files: bounded quantities, and strict sections."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

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
