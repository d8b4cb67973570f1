"""Tare: each tile's baseline and noise, from an interval without load.

Also the drift of baselines, with temperature since a tare and over a history of tares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.errors import TareError

IntervalSource = Literal["interval", "lead", "recognised", "unloaded", "flight"]
TareSource = IntervalSource | Literal["lost"]
_KPA_MAX = 1000.0
"""Largest valid pressure: eight times a chip's range, and no square overflows."""
_TILE_VALUES_MAX = {
    "baseline_kpa": _KPA_MAX,
    "baseline_sigma_kpa": _KPA_MAX,
    "noise_kpa": _KPA_MAX,
    "temperature_raw_counts": float(2**24),
    "noise_lasting": 1.0,
    "noise_lasting_s": 3600.0,
}
"""Largest valid value of each array."""
_OPTIONAL = ("noise_lasting", "noise_lasting_s")


@dataclass(frozen=True)
class Tare:
    """Baselines with their uncertainties; arrays over tiles.

    Attributes:
        baseline_kpa: absolute pressure unloaded.
        baseline_sigma_kpa: its standard uncertainty.
        noise_kpa: standard deviation of a single reading.
        temperature_raw_counts: mean raw temperature.
        t_ns: instant at which the interval ended, in UTC.
        begin_s: begin of the interval, in seconds from the first frame.
        end_s: its end.
        frames: number of frames in the interval.
        source: origin of the interval; "lost": the tare is damaged on disk. Its arrays are NaN, and
            so is every force while it is in force.
        noise_lasting: correlated part of the noise's variance; None: white noise is assumed.
        noise_lasting_s: time constant of that part; None likewise.
    """

    baseline_kpa: Floats
    baseline_sigma_kpa: Floats
    noise_kpa: Floats
    temperature_raw_counts: Floats
    t_ns: int
    begin_s: float
    end_s: float
    frames: int
    source: TareSource
    noise_lasting: Floats | None = None
    noise_lasting_s: Floats | None = None

    @classmethod
    def make_lost(cls, *, tiles: int, t_ns: int) -> Tare:
        """Make the stand-in of a lost tare that may have been in force from `t_ns` on."""
        unknown = np.full(tiles, np.nan)
        return cls(unknown, unknown, unknown, unknown, t_ns, 0.0, 0.0, 0, "lost")

    @property
    def is_lost(self) -> bool:
        """True for the stand-in of a lost tare."""
        return self.source == "lost"

    def as_dict(self) -> dict[str, Any]:
        """Return its content for JSON, with `None` for NaN."""
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            name: [None if np.isnan(x) else x for x in value.tolist()]
            if isinstance(value, np.ndarray)
            else value
            for name, value in content.items()
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, tiles: int) -> Tare:
        """Parse a tare of `tiles` tiles from JSON.

        Raises:
            TareError: it is no tare, or of another number of tiles.
        """
        try:
            if content["source"] == "lost":
                return cls.make_lost(tiles=tiles, t_ns=int(content["t_ns"]))
            if content["source"] not in get_args(IntervalSource):
                raise ValueError(f"source {content['source']!r}")  # noqa: TRY301  # caught with the others
            values: dict[str, Any] = {"source": content["source"]}
            values |= {name: int(content[name]) for name in ("t_ns", "frames")}
            values |= {name: float(content[name]) for name in ("begin_s", "end_s")}
            if not -(2**63) <= values["t_ns"] < 2**63:
                raise ValueError(f"t_ns is {values['t_ns']}")  # noqa: TRY301  # caught with the others
            for name, largest in _TILE_VALUES_MAX.items():
                if content[name] is None and name in _OPTIONAL:
                    continue
                values[name] = np.array(content[name], dtype=np.float64)
                is_possible = (values[name] >= 0.0) & (values[name] <= largest)
                if values[name].shape != (tiles,) or not is_possible.all():
                    raise ValueError(f"{name} is not that of {tiles} tiles")  # noqa: TRY301  # caught with the others
            return cls(**values)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise TareError(f"a recorded tare is not readable: {error}") from error


SEAL_TEMPERATURE_K = 298.0
"""A sealed bubble's pressure is proportional to its absolute temperature; about 25 degC."""
TEMPERATURE_CHANGE_MAX_K = 4.0 / 5.35  # four counts of an MPL115A2
"""Largest change of a chip's temperature since the tare with a valid baseline: 0.75 K are 0.25 kPa,
half a newton on a tile and one and a half on a foot of four."""
UNLOADED_SIGMA_MIN_KPA = 0.06
"""Least standard deviation of an unloaded reading about the baseline, however quiet the chip is:
the rubber keeps one or two parts in a hundred of a load for a second, and 0.2 K are as much."""
TREND_OVER_NS = 6 * 3_600_000_000_000
"""Time span of a trend."""
TREND_SPAN_MIN_NS = 600_000_000_000
"""Least time span of a trend in kPa/h."""


def compute_temperature_change_max_counts(counts_per_kelvin: Floats) -> Floats:
    """Return `TEMPERATURE_CHANGE_MAX_K` in counts of each chip."""
    return np.asarray(TEMPERATURE_CHANGE_MAX_K * np.abs(counts_per_kelvin))


def compute_warming_k(tare: Tare, temperature_counts: Floats, counts_per_kelvin: Floats) -> Floats:
    """Return the rise of each chip's temperature since the tare in kelvin; NaN where unknown."""
    return np.asarray((temperature_counts - tare.temperature_raw_counts) / counts_per_kelvin)


def compute_sealed_gas_shift_kpa(tare: Tare, warming_k: Floats) -> Floats:
    """Return the shift of a sealed bubble's baseline for a rise of temperature in kelvin."""
    return np.asarray(tare.baseline_kpa / SEAL_TEMPERATURE_K * warming_k)


def has_temperature_changed(
    tare: Tare, temperature_counts: npt.ArrayLike, counts_per_kelvin: Floats
) -> Bools:
    """Return a mask of tiles that warmed or cooled too far since the tare; False where unknown.

    Args:
        tare: in force; False for tiles without a temperature.
        temperature_counts: (..., tiles), NaN where unknown.
        counts_per_kelvin: (tiles,), of their chips.
    """
    moved_counts = np.abs(
        np.asarray(temperature_counts, dtype=np.float64) - tare.temperature_raw_counts
    )
    return np.asarray(moved_counts > compute_temperature_change_max_counts(counts_per_kelvin))


@dataclass(frozen=True)
class BaselineTrend:
    """Straight lines through a history of baselines; arrays over tiles, NaN if undetermined.

    Attributes:
        kpa_per_hour: slope of the baseline.
        sigma_kpa_per_hour: its standard uncertainty, from the tares' own.
        kelvin_per_hour: slope of the chip's temperature.
    """

    kpa_per_hour: Floats
    sigma_kpa_per_hour: Floats
    kelvin_per_hour: Floats


def fit_recent_baseline_trend(tares: Sequence[Tare], *, counts_per_kelvin: Floats) -> BaselineTrend:
    """Fit the trends of baseline and temperature over the last six hours; NaN below ten minutes.

    Args:
        tares: of the same tiles, in any order.
        counts_per_kelvin: (tiles,), of their chips.
    """
    newest_ns = max((tare.t_ns for tare in tares), default=0)
    recent = [tare for tare in tares if newest_ns - tare.t_ns <= TREND_OVER_NS]
    t_ns = np.array([tare.t_ns - newest_ns for tare in recent], dtype=np.float64)
    if not recent or -t_ns.min() < TREND_SPAN_MIN_NS:
        unknown = np.full(len(counts_per_kelvin), np.nan)
        return BaselineTrend(unknown, unknown, unknown)
    hours = t_ns / 3.6e12
    lever = (hours - hours.mean()) / ((hours - hours.mean()) ** 2).sum()
    by_tare = {
        name: np.array([getattr(tare, name) for tare in recent])
        for name in ("baseline_kpa", "baseline_sigma_kpa", "temperature_raw_counts")
    }
    return BaselineTrend(
        kpa_per_hour=(lever[:, None] * by_tare["baseline_kpa"]).sum(axis=0),
        sigma_kpa_per_hour=np.sqrt(((lever[:, None] * by_tare["baseline_sigma_kpa"]) ** 2).sum(0)),
        kelvin_per_hour=(lever[:, None] * by_tare["temperature_raw_counts"]).sum(axis=0)
        / counts_per_kelvin,
    )
