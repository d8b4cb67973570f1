"""Result of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from service.estimation.calibration import Calibration
from service.estimation.fitting.confidence import curve_n, mean_band_n, new_loading_band_n
from service.offline.compare.trials import OverTrials
from service.offline.reproduce.judge import Judged, over_all
from service.offline.reproduce.mill import DomeFound, pooled
from service.offline.reproduce.setups import Setup


@dataclass(frozen=True)
class Experiment:
    """Evaluated trials of one setup."""

    setup: Setup
    judged: tuple[Judged, ...]

    @property
    def figures(self) -> Mapping[str, OverTrials]:
        """Figures over trials."""
        return over_all(self.judged)


@dataclass(frozen=True)
class Reproduction:
    """Result of a reproduction.

    Attributes:
        software: version.
        made: time of the run, UTC.
        seed: seed of all random draws.
        quick: True for a shortened run.
        domes: results of the indented domes of Table I.
        calibration: calibration of the foot's tiles.
        experiments: experiments with at least one evaluated trial.
        not_borne_n: by experiment, the mean over trials of the vertical force on the loaded plate
            that no dome bears; known because it is emulated.
        failures: reasons of failed measurements, by name.
        seconds: run time, by step.
        notes: remarks on the run.
    """

    software: str
    made: str
    seed: int
    quick: bool
    domes: tuple[DomeFound, ...]
    calibration: Calibration | None
    experiments: tuple[Experiment, ...]
    not_borne_n: Mapping[str, float]
    failures: Mapping[str, str]
    seconds: Mapping[str, float]
    notes: Sequence[str] = ()

    def of(self, name: str) -> Experiment | None:
        """Return an experiment by name; None if it has no result."""
        return next((one for one in self.experiments if one.setup.name == name), None)

    @property
    def spread(self) -> tuple[float, tuple[float, float]] | None:
        """Standard deviation between loadings over all domes, with its 95 % interval."""
        if not self.domes:
            return None
        return pooled([one.spread for one in self.domes], self.domes[0].pressed.tile.repeats)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return {
            "software": self.software,
            "made": self.made,
            "seed": self.seed,
            "quick": self.quick,
            "seconds": self.seconds,
            "failures": self.failures,
            "notes": self.notes,
            "calibration": None if self.calibration is None else self.calibration.id,
            "domes": [_dome(one) for one in self.domes],
            "repeatability": self.spread,
            "experiments": {
                one.setup.name: {
                    "title": one.setup.title,
                    "instrument": one.setup.instrument,
                    "not_borne_n": self.not_borne_n.get(one.setup.name),
                    "figures": one.figures,
                    "trials": one.judged,
                }
                for one in self.experiments
            },
        }


def _dome(found: DomeFound) -> dict[str, object]:
    tile = found.pressed.tile
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 41)
    return {
        "name": found.dome.name,
        "material": found.dome.material.name,
        "modulus_mpa": found.dome.material.modulus_mpa,
        "diameter_mm": found.dome.diameter_mm,
        "loadings": tile.repeats,
        "full_scale_n": found.full_scale_n[0],
        "full_scale_half_95_n": found.full_scale_n[1],
        "pressed_to_full_scale": found.reached,
        "expected_n": [found.expected.low_n, found.expected.high_n],
        "expected_from": found.expected.basis,
        "r2": tile.r2,
        "r2_of_mean": None if tile.bench is None else tile.bench.r2_of_mean,
        "rmse_n": tile.rmse_n,
        "repeatability": found.spread,
        "coefficients": tile.coefficients,
        "p_offset_kpa": tile.p_offset_kpa,
        "p_scale_kpa": tile.p_scale_kpa,
        "curve": {
            "gauge_kpa": gauge_kpa.tolist(),
            "force_n": curve_n(tile, gauge_kpa).tolist(),
            "half_95_of_mean_n": mean_band_n(tile, gauge_kpa).tolist(),
            "half_95_of_loading_n": new_loading_band_n(tile, gauge_kpa).tolist(),
        },
    }
