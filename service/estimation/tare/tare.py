"""The tare: each tile's baseline and noise, from an interval without load.

Here also: how baselines move, with temperature since a tare and over a history of tares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.errors import TareError

TakenFrom = Literal["interval", "lead", "recognised", "unloaded", "flight"]
Source = TakenFrom | Literal["lost"]
_LASTING_MAX = {"noise_lasting": 1.0, "noise_lasting_s": 3600.0}
_KPA_MAX = 1000.0
"""Nine times as much as a chip tells, and near enough that no square of it overflows."""
_TADC_MAX = 1023.0


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
        source: how the interval was found; "lost": there was a tare, and it is not known what it
            said: its arrays are NaN, and so is every force while it is in force.
        noise_lasting: part of the noise's variance that lasts, 0 for white noise; None in tares of
            older versions, which took all for white.
        noise_lasting_s: how long it lasts, a time constant; likewise.
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
    noise_lasting: Floats | None = None
    noise_lasting_s: Floats | None = None

    @classmethod
    def lost(cls, *, tiles: int, t_ns: int) -> Tare:
        """In place of one that was lost; it may have been in force from `t_ns` on."""
        unknown = np.full(tiles, np.nan)
        return cls(unknown, unknown, unknown, unknown, t_ns, 0.0, 0.0, 0, "lost")

    @property
    def is_lost(self) -> bool:
        """Does it stand for one that was lost?"""
        return self.source == "lost"

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
            if content["source"] == "lost":
                return cls.lost(tiles=tiles, t_ns=int(content["t_ns"]))
            if content["source"] not in get_args(TakenFrom):
                raise ValueError(f"source {content['source']!r}")  # noqa: TRY301  # caught with the others
            values: dict[str, Any] = {"source": content["source"]}
            values |= {name: int(content[name]) for name in ("t_ns", "frames")}
            values |= {name: float(content[name]) for name in ("begin_s", "end_s")}
            if not -(2**63) <= values["t_ns"] < 2**63:
                raise ValueError(f"t_ns is {values['t_ns']}")  # noqa: TRY301  # caught with the others
            for name in ("baseline_kpa", "baseline_sigma_kpa", "noise_kpa"):
                values[name] = np.array(content[name], dtype=np.float64)
                is_possible = (values[name] >= 0.0) & (values[name] <= _KPA_MAX)
                if values[name].shape != (tiles,) or not is_possible.all():
                    raise ValueError(f"{name} is not that of {tiles} tiles")  # noqa: TRY301  # caught with the others
            counts = content.get("tadc_counts") or [None] * tiles
            values["tadc_counts"] = np.array(counts, dtype=np.float64)  # None becomes NaN
            is_none = (values["tadc_counts"] < 0.0) | (values["tadc_counts"] > _TADC_MAX)
            if values["tadc_counts"].shape != (tiles,) or is_none.any():
                raise ValueError(f"tadc_counts are not those of {tiles} tiles")  # noqa: TRY301  # caught with the others
            for name in ("noise_lasting", "noise_lasting_s"):
                if content.get(name) is not None:
                    values[name] = np.array(content[name], dtype=np.float64)
                    is_possible = (values[name] >= 0.0) & (values[name] <= _LASTING_MAX[name])
                    if values[name].shape != (tiles,) or not is_possible.all():
                        raise ValueError(f"{name} is not that of {tiles} tiles")  # noqa: TRY301  # caught with the others
            return cls(**values)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise TareError(f"a recorded tare is not readable: {error}") from error


SEALED_AT_K = 298.0
"""A sealed bubble's pressure is proportional to its absolute temperature; about 25 degC."""
WARMED_COUNTS = 4.0
"""A baseline is in doubt if a tile's chip changed by more since the tare: 0.75 K are 0.25 kPa,
half a newton on a tile and one and a half on a foot of four."""
TREND_OVER_NS = 6 * 3_600_000_000_000
"""A trend is over the last hours; earlier tares are another day's."""
TREND_SPAN_MIN_NS = 600_000_000_000
"""A straight line through less than ten minutes says nothing about an hour."""


def warmer_k(tare: Tare, tadc_counts: Floats) -> Floats:
    """How much warmer each chip is than at the tare; NaN where that is not known."""
    return np.asarray((tadc_counts - tare.tadc_counts) / TADC_PER_KELVIN)


def expected_shift_kpa(tare: Tare, warmer: Floats) -> Floats:
    """What a sealed bubble's baseline moves by when it gets so much warmer, in kelvin."""
    return np.asarray(tare.baseline_kpa / SEALED_AT_K * warmer)


def has_warmed(tare: Tare, tadc_counts: npt.ArrayLike) -> Bools:
    """Which tiles are warmer or colder than at the tare by more than the baseline can bear.

    Args:
        tare: the one in force; with an unknown temperature the answer is never True.
        tadc_counts: (..., tiles), NaN where not known.
    """
    moved_counts = np.abs(np.asarray(tadc_counts, dtype=np.float64) - tare.tadc_counts)
    return np.asarray(moved_counts > WARMED_COUNTS)


@dataclass(frozen=True)
class Trend:
    """Straight lines through a history of baselines; arrays over tiles, NaN if undetermined.

    Attributes:
        kpa_per_hour: of the baseline.
        sigma_kpa_per_hour: its standard uncertainty, from the tares' own.
        kelvin_per_hour: of the chip.
    """

    kpa_per_hour: Floats
    sigma_kpa_per_hour: Floats
    kelvin_per_hour: Floats


def trend(tares: Sequence[Tare], *, tiles: int) -> Trend:
    """The trend of the last hours.

    Args:
        tares: of the same tiles, that were in force, in any order.
        tiles: how many tiles that is.
    """
    newest_ns = max((tare.t_ns for tare in tares), default=0)
    recent = [tare for tare in tares if newest_ns - tare.t_ns <= TREND_OVER_NS]
    t_ns = np.array([tare.t_ns - newest_ns for tare in recent], dtype=np.float64)
    if not recent or -t_ns.min() < TREND_SPAN_MIN_NS:
        unknown = np.full(tiles, np.nan)
        return Trend(unknown, unknown, unknown)
    hours = t_ns / 3.6e12
    lever = (hours - hours.mean()) / ((hours - hours.mean()) ** 2).sum()
    by_tare = {
        name: np.array([getattr(tare, name) for tare in recent])
        for name in ("baseline_kpa", "baseline_sigma_kpa", "tadc_counts")
    }
    return Trend(
        kpa_per_hour=(lever[:, None] * by_tare["baseline_kpa"]).sum(axis=0),
        sigma_kpa_per_hour=np.sqrt(((lever[:, None] * by_tare["baseline_sigma_kpa"]) ** 2).sum(0)),
        kelvin_per_hour=(lever[:, None] * by_tare["tadc_counts"]).sum(axis=0) / TADC_PER_KELVIN,
    )
