"""Result of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from service.estimation.calibration import Calibration
from service.estimation.fitting.confidence import (
    compute_curve_n,
    compute_mean_half_width_95_n,
    compute_new_loading_half_width_95_n,
)
from service.offline.compare.trials import TrialMean
from studies.reproduce.evaluation import TrialResult, average_trial_figures
from studies.reproduce.indentation import DomeResult, pool_repeatability
from studies.reproduce.trials import ExperimentSetup


@dataclass(frozen=True)
class ExperimentResult:
    """Evaluated trials of one setup."""

    setup: ExperimentSetup
    trials: tuple[TrialResult, ...]

    @property
    def figures(self) -> Mapping[str, TrialMean]:
        """Figures over trials."""
        return average_trial_figures(self.trials)


@dataclass(frozen=True)
class Reproduction:
    """Result of a reproduction.

    Attributes:
        software: version.
        run_at: time of the run, UTC.
        seed: seed of all random draws.
        is_shortened: True for a shortened run.
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
    run_at: str
    seed: int
    is_shortened: bool
    domes: tuple[DomeResult, ...]
    calibration: Calibration | None
    experiments: tuple[ExperimentResult, ...]
    not_borne_n: Mapping[str, float]
    failures: Mapping[str, str]
    seconds: Mapping[str, float]
    notes: Sequence[str] = ()

    def find_experiment(self, name: str) -> ExperimentResult | None:
        """Return an experiment by name; None if it has no result."""
        return next((one for one in self.experiments if one.setup.name == name), None)

    @property
    def repeatability(self) -> tuple[float, tuple[float, float]] | None:
        """Standard deviation between loadings over all domes, with its 95 % interval."""
        if not self.domes:
            return None
        return pool_repeatability(
            [one.repeatability for one in self.domes], self.domes[0].indented_tile.tile.repeats
        )

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return {
            "software": self.software,
            "made": self.run_at,
            "seed": self.seed,
            "quick": self.is_shortened,
            "seconds": self.seconds,
            "failures": self.failures,
            "notes": self.notes,
            "calibration": None if self.calibration is None else self.calibration.id,
            "domes": [_dome_to_dict(one) for one in self.domes],
            "repeatability": self.repeatability,
            "experiments": {
                one.setup.name: {
                    "title": one.setup.title,
                    "instrument": one.setup.instrument,
                    "not_borne_n": self.not_borne_n.get(one.setup.name),
                    "figures": one.figures,
                    "trials": one.trials,
                }
                for one in self.experiments
            },
        }


def _dome_to_dict(found: DomeResult) -> dict[str, object]:
    tile = found.indented_tile.tile
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 41)
    return {
        "name": found.dome.name,
        "material": found.dome.material.name,
        "modulus_mpa": found.dome.material.modulus_mpa,
        "diameter_mm": found.dome.diameter_mm,
        "loadings": tile.repeats,
        "full_scale_n": found.full_scale_n[0],
        "full_scale_half_95_n": found.full_scale_n[1],
        "pressed_to_full_scale": found.is_full_scale_reached,
        "expected_n": [found.expected_range.low_n, found.expected_range.high_n],
        "expected_from": found.expected_range.source,
        "r2": tile.r2,
        "r2_of_mean": None if tile.rig is None else tile.rig.r2_of_mean,
        "rmse_n": tile.rmse_n,
        "repeatability": found.repeatability,
        "coefficients": tile.coefficients,
        "p_offset_kpa": tile.p_offset_kpa,
        "p_scale_kpa": tile.p_scale_kpa,
        "curve": {
            "gauge_kpa": gauge_kpa.tolist(),
            "force_n": compute_curve_n(tile, gauge_kpa).tolist(),
            "half_95_of_mean_n": compute_mean_half_width_95_n(tile, gauge_kpa).tolist(),
            "half_95_of_loading_n": compute_new_loading_half_width_95_n(tile, gauge_kpa).tolist(),
        },
    }
