"""Result of a reproduction.

The comparison uses two files and the options a user would give. Afterwards, for the report only,
its result is checked against the true clock, gain and offset of the emulated instrument.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from devices.emulation import plates as force_plate
from devices.emulation import plates as pressure_plate
from devices.emulation.ground.grounds import make_ground
from devices.emulation.plates import VERTICAL
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
    compute_new_loading_half_width_95_n,
)
from service.offline.compare.block_covariance import UncertainValue
from service.offline.compare.paired_frames import TrialMean, average_over_trials
from service.offline.comparison import CompareOptions, Comparison, compare_session
from service.rig.emulated_foot import make_injected_path
from storage.formats.reference import ReferenceOptions
from storage.sessions.reader import SealedFileReader
from studies.reproduce.experiments import (
    FORCE_PLATE,
    DomeResult,
    ExperimentSetup,
    pool_repeatability,
)
from studies.reproduce.video_angle import AngleComparison

_STEP_S = 1e-3
_LOADED_N = 0.5
REPORTED_FIGURES = (
    "grf_mae_n",
    "grf_bias_n",
    "grf_rmse_n",
    "grf_coverage_95",
    "peak_mae_n",
    "impulse_mae_n_s",
    "cop_mean_m",
    "cop_p95_m",
    "cop_p95_about_mean_m",
    "cop_coverage_x_95",
)
"""Figures of a comparison shown in the report."""


@dataclass(frozen=True)
class InjectedValueCheck:
    """Property of the reference, as found by the comparison and as injected.

    Attributes:
        found: value found; None if not determined.
        injected: true value.
        beside: standard deviation that the instrument's slow noise adds to the true value.
    """

    found: UncertainValue | None
    injected: float
    beside: float = 0.0

    @property
    def error_in_half_intervals(self) -> float:
        """Found minus injected, in half widths of the 95 % interval; NaN if nothing was found."""
        if self.found is None:
            return math.nan
        sigma = float(np.hypot(self.found.sigma, self.beside))
        low, high = replace(self.found, sigma=sigma).interval_95
        return (self.found.value - self.injected) / (0.5 * (high - low))

    @property
    def is_inside_interval(self) -> bool:
        """True if the injected value is within the 95 % interval."""
        return abs(self.error_in_half_intervals) <= 1.0


@dataclass(frozen=True)
class TrialResult:
    """Result of one trial.

    Attributes:
        name: name of the trial.
        comparison: comparison with its reference.
        checks: checks of lag (s), drift (ppm), offset (N) and scale.
        frames: number of frames of the session.
        rate_hz: frame rate.
        lost_frames: number of frames missing in the session.
        missed_slots: number of time slots without a frame.
    """

    name: str
    comparison: Comparison
    checks: Mapping[str, InjectedValueCheck]
    frames: int
    rate_hz: float
    lost_frames: int = 0
    missed_slots: int = 0

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the comparison's only trial."""
        return {name: over.mean for name, over in self.comparison.errors.figures.items()}

    def as_dict(self) -> dict[str, object]:
        """Return the content that `service.json_output.to_json_value` converts."""
        return {
            "name": self.name,
            "frames": self.frames,
            "rate_hz": self.rate_hz,
            "lost_frames": self.lost_frames,
            "missed_slots": self.missed_slots,
            "figures": self.figures,
            "notes": self.comparison.notes,
            "reference": {
                name: {
                    "found": check.found,
                    "injected": check.injected,
                    "off_by_half_intervals": check.error_in_half_intervals,
                    "inside": check.is_inside_interval,
                }
                for name, check in self.checks.items()
            },
        }


def evaluate_trial(
    setup: ExperimentSetup,
    name: str,
    session_path: Path,
    reference_path: Path,
    *,
    lost_frames: int = 0,
    missed_slots: int = 0,
) -> TrialResult:
    """Compare a trial with its reference, and check the result against the injected values.

    Raises:
        FootTileError: the two cannot be compared.
    """
    of_force = setup.instrument == FORCE_PLATE
    stated = ReferenceOptions({"grf_n": "fz_n"}) if of_force else ReferenceOptions()
    plate = force_plate if of_force else pressure_plate
    comparison = compare_session(
        session_path,
        reference_path,
        CompareOptions(
            stated=stated,
            remove_offset=True,
            reference_sigma_n=plate.STATED_SIGMA_N,
            reference_cop_sigma_m=None if of_force else pressure_plate.STATED_COP_SIGMA_M,
        ),
    )
    with SealedFileReader(session_path) as reader:
        t_ns = np.concatenate([piece["t_mono_ns"] for piece in reader.read_quantities("t_mono_ns")])
    injected = json.loads(make_injected_path(reference_path).read_text())
    return TrialResult(
        name=name,
        comparison=comparison,
        checks=_check_injected_values(comparison, injected, int(t_ns[0]), of_force=of_force),
        frames=len(t_ns),
        rate_hz=1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0]),
        lost_frames=lost_frames,
        missed_slots=missed_slots,
    )


def _check_injected_values(
    comparison: Comparison, injected: Mapping[str, float], begin_ns: int, *, of_force: bool
) -> dict[str, InjectedValueCheck]:
    alignment, pairs = comparison.alignment, comparison.pairs
    since_s = (begin_ns - int(injected["zero_t_mono_ns"])) * 1e-9 + alignment.mid_t_s
    shown_s = since_s * (1.0 + 1e-6 * injected["drift_ppm"]) + injected["delay_s"]
    in_flight = alignment.to_reference_time_s(pairs.t_s[~pairs.reference_contact])
    at_s = float(in_flight.mean()) if len(in_flight) else 0.0
    slow_n = float(force_plate.SLOW * force_plate.RANGE[VERTICAL]) if of_force else 0.0
    return {
        "lag_s": InjectedValueCheck(alignment.lag_s, shown_s - alignment.mid_t_s),
        "drift_ppm": InjectedValueCheck(alignment.drift_ppm, injected["drift_ppm"]),
        "offset_n": InjectedValueCheck(
            pairs.reference_zero_n,
            injected["offset_n"] + injected["offset_creep_n_per_s"] * at_s,
            beside=slow_n,
        ),
        "scale": InjectedValueCheck(alignment.scale, 1.0 / injected["gain"]),
    }


def average_trial_figures(trials: Sequence[TrialResult]) -> dict[str, TrialMean]:
    """Average every figure over trials, with its interval."""
    return {
        name: average_over_trials(np.array([one.figures[name] for one in trials], dtype=np.float64))
        for name in (trials[0].figures if trials else ())
    }


def compute_not_borne_n(scene: Scene, seed: int, seconds: float) -> float:
    """Compute the mean force beside the domes' in N: rim, drag, suction and buoyancy on the plate.

    Over one trial without lead-in, while the plate is loaded. It is known in emulation only: the
    report states how much of the difference between foot and plate is not the foot's error; no
    comparison uses it.
    """
    ground = make_ground(scene, seed=seed, lead_s=0.0, tile_load=None)
    t_s = np.arange(0.0, seconds, _STEP_S)
    borne_n = (ground.forces_n(t_s) * np.cos(ground.tilt_rad(t_s))).sum(axis=1)
    rest_n = ground.force_beside_domes_n(t_s)
    loaded = borne_n + rest_n > _LOADED_N
    return float(np.abs(rest_n[loaded]).mean())


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
        angles: angle of `rolling` by servo and by video; None if not asked for, or failed.
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
    angles: AngleComparison | None = None

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
        """Return the content that `service.json_output.to_json_value` converts."""
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
            **({} if self.angles is None else {"angles": self.angles}),
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
            "force_n": compute_curve_through_zero_n(tile, gauge_kpa).tolist(),
            "half_95_of_mean_n": compute_mean_curve_half_width_95_n(tile, gauge_kpa).tolist(),
            "half_95_of_loading_n": compute_new_loading_half_width_95_n(tile, gauge_kpa).tolist(),
        },
    }
