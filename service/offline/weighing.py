"""The steps of a calibration with dead weights, followed by what the tile reads.

Nobody has a hand free for a key: a weight that was put on shows in the tile's pressure, and so does
one that was taken off. `Weighing` waits until the pressure is steady, has the step marked, watches
it for some seconds, and goes on; a step in which something moved is withdrawn and made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from devices.arrays import Floats

REST_S = 4.0
HOLD_S = 5.0
"""Marks come some tenths of a second late; a fit takes no step that is shorter than 2 s."""
STEADY_S = 1.0
"""So long the pressure has to stand still before a step begins."""
LOADED_KPA = 0.3
"""A pressure that is so far above that of the rest is a load; a light weight gives 0.5 kPa."""
MOVED_PART = 0.15
"""A step whose pressure moves by more than that part of it is made again: creep stays below."""
_MOVED_KPA = 0.15  # or by more than this, where the part is less
_BIN_S = 0.25  # readings are averaged over this, or noise would look like movement
_WINDOW_BINS = round(STEADY_S / _BIN_S)

StepName = Literal["empty", "resting", "put on", "holding", "done"]


@dataclass(frozen=True)
class Begin:
    """A step begins: have it marked with this label."""

    label: str


@dataclass(frozen=True)
class End:
    """The step is over."""


@dataclass(frozen=True)
class Withdraw:
    """Something moved: remove the marks of the newest step."""

    reason: str


Action = Begin | End | Withdraw


@dataclass(frozen=True)
class Repeatability:
    """What a step's pressure is like so far, in kPa; above the rest for a weight."""

    mean_kpa: float
    spread_kpa: float
    """Standard deviation of quarter seconds."""
    settle_kpa: float
    """Newest quarter second less the first."""


class Weighing:
    """One pass over a list of weights on one tile.

    Args:
        serial: of the tile.
        weights: as they are written in marks, in the order in which they are put on.
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
        self._held_kpa = 0.0  # of the last weight
        self._bins: list[float] = []
        self._in_step: list[float] = []
        self._sum, self._count, self._bin_ends_s = 0.0, 0, -np.inf

    @property
    def prompt(self) -> str:
        """What to do now, in a sentence."""
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
        """Take readings of the tile, and return what has to be marked, in order.

        Args:
            t_s: (n,), instants in seconds, rising from call to call.
            kpa: (n,), absolute pressures; NaN where there was none.
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
        """Go on by a quarter of a second."""
        self._bins = [*self._bins[1 - _WINDOW_BINS :], kpa]
        match self.step:
            case "empty" if self._is_steady(0.0) and self._is_empty(kpa):
                return self._begin("resting", "rest")
            case "put on" if kpa < self._rest_kpa - LOADED_KPA:
                # What looked like a rest was a load, or had not settled.
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
        """Return whether the last weight is off; its creep goes back slowly."""
        return self.number == 0 or kpa < self._rest_kpa + max(LOADED_KPA, 0.3 * self._held_kpa)
