"""Which trials there are, and what a node is to be told for each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from service.offline.reproduce.setups import Setup

LEAD_S = 1.5
"""Without load before each trial: the tare, and time for a plate to be started."""


@dataclass(frozen=True)
class TrialPlan:
    """One trial of a setup.

    Attributes:
        setup: which.
        number: from 1.
        seed: draws its noise and ground, and how the plate was set up.
        reference: file of its plate.
        is_repeated: was it spoiled before?
    """

    setup: Setup
    number: int
    seed: int
    reference: Path

    is_repeated: bool = False

    @property
    def trial(self) -> str:
        """Its name, however often it is tried."""
        return f"{self.setup.name}-{self.number}"

    @property
    def name(self) -> str:
        """Of node and session."""
        return f"{self.trial}-again" if self.is_repeated else self.trial

    def again(self) -> TrialPlan:
        """The same, after it was spoiled; of a seed of its own it would be another trial."""
        path = self.reference
        beside = path.with_name(f"{path.stem}-again{path.suffix}")
        return replace(self, is_repeated=True, reference=beside)

    @property
    def seconds(self) -> float:
        """To record from when the node is there: its scene's time began a moment before."""
        return LEAD_S + self.setup.seconds

    def arguments(self, scene: Path, parts_seed: int) -> list[str]:
        """Of `foottile node`."""
        return [
            f"--scene={scene}",
            f"--seed={self.seed}",
            f"--parts-seed={parts_seed}",
            f"--lead-s={LEAD_S}",
            f"{self.setup.option}={self.reference}",
        ]


def plans(setups: tuple[Setup, ...], trials: int, seed: int, folder: Path) -> list[TrialPlan]:
    """All trials, those of a setup one after another."""
    return [
        TrialPlan(
            setup,
            number,
            seed + number,
            folder / f"{setup.name}-{number}{setup.ending}",
        )
        for setup in setups
        for number in range(1, trials + 1)
    ]
