"""State machine of a calibration with dead weights, driven by the tile's pressure.

The user's hands are busy, so no key is needed: adding or removing a weight shows in the pressure.
`WeighingProcedure` waits until the pressure is steady, requests the step's marker, observes it for
some seconds, and continues. A step with movement is withdrawn and repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from devices.arrays import Floats

REST_S = 4.0
HOLD_S = 5.0
"""Durations of a step: markers are some tenths of a second late, and a fit needs 2 s per step."""
STEADY_S = 1.0
"""Time with steady pressure before a step begins."""
LOADED_KPA = 0.3
"""Pressure above rest that counts as a load; a light weight gives 0.5 kPa."""
MOVED_PART = 0.15
"""Relative change of a step's pressure from which it is repeated; creep stays below."""
_MOVED_KPA = 0.15  # least absolute change
_BIN_S = 0.25  # averaging time, so that noise does not look like movement
_WINDOW_BINS = round(STEADY_S / _BIN_S)

StepName = Literal["empty", "resting", "put on", "holding", "done"]


@dataclass(frozen=True)
class Begin:
    """Action: a step begins; set a marker with this label."""

    label: str


@dataclass(frozen=True)
class End:
    """Action: the step is over."""


@dataclass(frozen=True)
class Withdraw:
    """Action: movement was detected; remove the markers of the newest step."""

    reason: str


Action = Begin | End | Withdraw


@dataclass(frozen=True)
class Repeatability:
    """Statistics of the current step's pressure, in kPa; above rest for a weight."""

    mean_kpa: float
    spread_kpa: float
    """Standard deviation of quarter-second means."""
    settle_kpa: float
    """Latest quarter-second mean minus the first."""


class Weighing:
    """Procedure for one series of weights on one tile.

    Args:
        serial: serial of the tile.
        weights: weights as written in markers, in loading order.
    """

    def __init__(self, serial: str, weights: Sequence[str]) -> None:
        self.serial = serial
        self.weights = tuple(weights)
        self.number = 0
        """Of the weight that is next, or on the tile."""
        self.step: StepName = "empty"
        self.repeatability: Repeatability | None = None
        """Of the step under way, or of the last one."""
        self._rest_kpa = np.nan
        self._held_kpa = 0.0  # pressure of the last weight
        self._bins: list[float] = []
        self._in_step: list[float] = []
        self._sum, self._count, self._bin_ends_s = 0.0, 0, -np.inf

    @property
    def prompt(self) -> str:
        """Instruction for the user, in a sentence."""
        weight = self.weights[self.number] if self.number < len(self.weights) else ""
        place = f"{self.number + 1} of {len(self.weights)}"
        return {
            "empty": f"Take everything off tile {self.serial}.",
            "resting": f"Leave tile {self.serial} empty.",
            "put on": f"Put {weight} on tile {self.serial} ({place}) and let go.",
            "holding": f"Leave {weight} where it is ({place}).",
            "done": f"All weights are done. Take everything off tile {self.serial}.",
        }[self.step]

    def push(self, t_s: Floats, kpa: Floats) -> list[Action]:
        """Process readings of the tile, and return the resulting actions in order.

        Args:
            t_s: (n,), times in seconds, rising from call to call.
            kpa: (n,), absolute pressures; NaN where missing.
        """
        actions: list[Action] = []
        for at_s, reading_kpa in zip(t_s.tolist(), kpa.tolist(), strict=True):
            if at_s >= self._bin_ends_s:
                if self._count:
                    actions += self._advance(self._sum / self._count)
                self._sum, self._count, self._bin_ends_s = 0.0, 0, at_s + _BIN_S
            if np.isfinite(reading_kpa):
                self._sum, self._count = self._sum + reading_kpa, self._count + 1
        return actions

    def _advance(self, kpa: float) -> list[Action]:
        """Advance by a quarter of a second."""
        self._bins = [*self._bins[1 - _WINDOW_BINS :], kpa]
        match self.step:
            case "empty" if self._is_steady(0.0) and self._is_empty(kpa):
                return self._begin("resting", "rest")
            case "put on" if kpa < self._rest_kpa - LOADED_KPA:
                # The assumed rest was a load, or had not settled.
                self.step = "empty"
                return [Withdraw("the tile was not at rest")]
            case "put on" if self._is_steady(self._rest_kpa) and self._is_loaded(kpa):
                return self._begin("holding", self.weights[self.number])
            case "resting" | "holding":
                return self._watch(kpa)
            case _:
                return []

    def _begin(self, step: StepName, label: str) -> list[Action]:
        self.step, self._in_step = step, []
        return [Begin(f"{self.serial} {label}")]

    def _watch(self, kpa: float) -> list[Action]:
        is_weight = self.step == "holding"
        zero_kpa = self._rest_kpa if is_weight else 0.0
        self._in_step.append(kpa - zero_kpa)
        first, newest = self._in_step[0], self._in_step[-1]
        self.repeatability = Repeatability(
            mean_kpa=float(np.mean(self._in_step)),
            spread_kpa=float(np.std(self._in_step)),
            settle_kpa=newest - first,
        )
        allowed_kpa = max(_MOVED_KPA, MOVED_PART * first) if is_weight else LOADED_KPA
        if abs(newest - first) > allowed_kpa:
            self.step, self._bins = ("put on", []) if is_weight else ("empty", [])
            return [Withdraw(f"the pressure moved by {newest - first:+.2f} kPa")]
        if len(self._in_step) * _BIN_S < (HOLD_S if is_weight else REST_S):
            return []
        self._bins = []
        if is_weight:
            self.number += 1
            self._held_kpa = self.repeatability.mean_kpa
            self.step = "done" if self.number == len(self.weights) else "empty"
        else:
            self._rest_kpa = float(np.mean(self._in_step[-_WINDOW_BINS:]))
            self.step = "put on"
        return [End()]

    def _is_steady(self, zero_kpa: float) -> bool:
        if len(self._bins) < _WINDOW_BINS:
            return False
        level_kpa = abs(self._bins[-1] - zero_kpa) if zero_kpa else 0.0
        return bool(np.ptp(self._bins) < max(_MOVED_KPA, 0.05 * level_kpa))

    def _is_loaded(self, kpa: float) -> bool:
        return kpa > self._rest_kpa + LOADED_KPA

    def _is_empty(self, kpa: float) -> bool:
        """Return whether the last weight is off, allowing for slow recovery of creep."""
        return self.number == 0 or kpa < self._rest_kpa + max(LOADED_KPA, 0.3 * self._held_kpa)
