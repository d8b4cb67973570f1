"""The tare: each tile's baseline and noise, from an interval without load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from devices.arrays import Floats
from devices.errors import TareError

Source = Literal["interval", "lead", "recognised", "unloaded", "flight"]


@dataclass(frozen=True)
class Tare:
    """Baselines with their uncertainty; arrays over tiles.

    Attributes:
        baseline_kpa: absolute pressure unloaded.
        baseline_sigma_kpa: its standard uncertainty.
        noise_kpa: standard deviation of a single reading.
        tadc_counts: mean temperature counts; NaN in tares of older versions, which kept none.
        t_ns: instant at which the interval ended, in UTC.
        begin_s: begin of the interval, in seconds from the first frame.
        end_s: its end.
        frames: number of frames it was taken from.
        source: how the interval was found.
    """

    baseline_kpa: Floats
    baseline_sigma_kpa: Floats
    noise_kpa: Floats
    tadc_counts: Floats
    t_ns: int
    begin_s: float
    end_s: float
    frames: int
    source: Source

    def as_dict(self) -> dict[str, Any]:
        """For JSON, which has no NaN: `None`."""
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            name: [None if np.isnan(x) else x for x in value.tolist()]
            if isinstance(value, np.ndarray)
            else value
            for name, value in content.items()
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, tiles: int) -> Tare:
        """From JSON, for an array of `tiles` tiles.

        Raises:
            TareError: it is no tare, or of another number of tiles.
        """
        try:
            values: dict[str, Any] = {"source": str(content["source"])}
            values |= {name: int(content[name]) for name in ("t_ns", "frames")}
            values |= {name: float(content[name]) for name in ("begin_s", "end_s")}
            for name in ("baseline_kpa", "baseline_sigma_kpa", "noise_kpa"):
                values[name] = np.array(content[name], dtype=np.float64)
                if values[name].shape != (tiles,) or not np.isfinite(values[name]).all():
                    raise ValueError(f"{name} is not that of {tiles} tiles")  # noqa: TRY301  # caught with the others
            counts = content.get("tadc_counts") or [None] * tiles
            values["tadc_counts"] = np.array(counts, dtype=np.float64)  # None becomes NaN
            if values["tadc_counts"].shape != (tiles,):
                raise ValueError(f"tadc_counts are not those of {tiles} tiles")  # noqa: TRY301  # caught with the others
            return cls(**values)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise TareError(f"a recorded tare is not readable: {error}") from error
