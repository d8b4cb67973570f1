"""Plan of all trials, with each node's command-line arguments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from service.offline.reproduce.setups import ExperimentSetup

LEAD_S = 1.5
"""Unloaded lead-in of each trial, for the tare and the plate's start."""


@dataclass(frozen=True)
class TrialPlan:
    """Plan of one trial of a setup.

    Attributes:
        setup: its setup.
        number: number, from 1.
        seed: seed of noise, ground and the plate's properties.
        reference_path: path of the plate's file.
        is_repeated: True for the repetition of a failed trial.
    """

    setup: ExperimentSetup
    number: int
    seed: int
    reference_path: Path

    is_repeated: bool = False

    @property
    def trial_name(self) -> str:
        """Name of the trial, the same for its repetition."""
        return f"{self.setup.name}-{self.number}"

    @property
    def session_name(self) -> str:
        """Name of node and session."""
        return f"{self.trial_name}-again" if self.is_repeated else self.trial_name

    def make_repetition(self) -> TrialPlan:
        """Return the plan of a repetition with the same seed, after a failure."""
        path = self.reference_path
        beside = path.with_name(f"{path.stem}-again{path.suffix}")
        return replace(self, is_repeated=True, reference_path=beside)

    @property
    def recording_seconds(self) -> float:
        """Recording time from the node's connection on, shortly after its scene begins."""
        return LEAD_S + self.setup.trial_seconds

    def make_node_arguments(self, scene: Path, parts_seed: int) -> list[str]:
        """Return the arguments of `foottile node`."""
        return [
            f"--scene={scene}",
            f"--seed={self.seed}",
            f"--parts-seed={parts_seed}",
            f"--lead-s={LEAD_S}",
            f"{self.setup.node_option}={self.reference_path}",
        ]


def plan_trials(
    setups: tuple[ExperimentSetup, ...], trials: int, seed: int, folder: Path
) -> list[TrialPlan]:
    """Plan all trials, in order of setups."""
    return [
        TrialPlan(
            setup,
            number,
            seed + number,
            folder / f"{setup.name}-{number}{setup.file_suffix}",
        )
        for setup in setups
        for number in range(1, trials + 1)
    ]
