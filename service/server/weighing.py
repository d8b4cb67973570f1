"""Steps of a calibration with known weights, which follow from the tile's pressure.

The operator has no hand free for a key: the pressure shows when a weight is put on or taken off.
`Weighing` waits until the pressure is steady, marks the beginning of a step, watches it for some
seconds, and goes on. A step in which something moves is withdrawn and repeated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from devices.arrays import Floats, Times

REST_S = 4.0
HOLD_S = 5.0
"""A fit refuses a step shorter than 2 s."""
STEADY_S = 1.0
"""Time of steady pressure before a step begins."""
LOADED_KPA = 0.3
"""Least pressure of a load above that of the rest; a light weight gives 0.5 kPa."""
MOVED_PART = 0.15
"""Relative change of pressure above which a step is repeated; creep stays below."""
TRACE_S = 20.0
"""Length of `Weighing.recent_kpa`."""
_MOVED_KPA = 0.15  # or by more than this, where the part is less
_BIN_S = 0.25  # readings are averaged over this, or noise would look like movement
_WINDOW_BINS = round(STEADY_S / _BIN_S)
_GAP_S = 1.0  # a step with a longer gap was not watched

StepName = Literal["empty", "resting", "put on", "holding", "done"]
Method = Literal["weights", "scale", "sensor"]
"""Reference of the force: dead weights, a kitchen scale under the tile, or a force sensor."""


@dataclass(frozen=True)
class Begin:
    """Beginning of a step: a marker with this label, at this instant of the node's UTC."""

    label: str
    t_ns: int


@dataclass(frozen=True)
class End:
    """End of the step."""

    t_ns: int


@dataclass(frozen=True)
class Withdraw:
    """Removal of the markers of the newest step."""

    reason: str


MarkerChange = Begin | End | Withdraw


@dataclass(frozen=True)
class Repeatability:
    """Pressure of a step up to now, in kPa; of a weight, relative to the rest before it."""

    mean_kpa: float
    spread_kpa: float
    """Standard deviation of quarter seconds."""
    settle_kpa: float
    """Newest quarter second less the first."""


class Weighing:
    """One pass over a list of weights on one tile.

    Args:
        serial: of the tile.
        weights: as markers have them, in the order in which they are put on.
        method: reference of the force.
    """

    def __init__(self, serial: str, weights: Sequence[str], method: Method = "weights") -> None:
        self.serial = serial
        self.weights = tuple(weights)
        self.step: StepName = "empty"
        self.held: list[Repeatability] = []
        """Weights that are done."""
        self.repeatability: Repeatability | None = None
        """Pressure of the step under way, or of the last one."""
        self.recent_kpa: deque[float] = deque(maxlen=round(TRACE_S / _BIN_S))
        """Absolute pressure of the newest quarter seconds."""
        self.rest_kpa = np.nan
        """Absolute pressure of the last rest."""
        self._method = method
        self._on_kpa = 0.0  # of the last weight, whose creep goes back slowly
        self._bins: list[float] = []
        self._in_step: list[float] = []
        self._sum, self._count, self._bin_ends_s = 0.0, 0, -np.inf
        self._last_s = np.inf

    @property
    def weight_index(self) -> int:
        """Index in `weights` of the weight that is next, or on the tile."""
        return len(self.held)

    @property
    def left_s(self) -> float | None:
        """Rest of the step under way; None between steps."""
        if self.step not in ("resting", "holding"):
            return None
        return self._step_s - len(self._in_step) * _BIN_S

    @property
    def prompt(self) -> str:
        """Instruction for now, in a sentence."""
        tile = self.serial
        match self.step:
            case "resting":
                return f"Keep {tile} empty"
            case "holding":
                return "Hold still"
            case "empty" if np.isnan(self.rest_kpa) or not self._is_empty(self._newest_kpa):
                return f"{'Take everything off' if self._method == 'weights' else 'Release'} {tile}"
            case "empty":
                return f"Hands off {tile}: the pressure settles"
            case "put on" if self._is_loaded(self._newest_kpa):
                return f"Let go of {tile}: the pressure settles"
            case "put on":
                weight, _, _ = self.weights[self.weight_index].partition(" +-")
                return {
                    "weights": f"Put {weight} on {tile}",
                    "scale": f"Press {tile} until the scale reads {weight}, and clamp it",
                    "sensor": f"Press {tile} until the sensor reads {weight}, and clamp it",
                }[self._method]
            case _:
                return f"All weights are done: unload {tile}"

    def feed_tile_pressures(self, t_ns: Times, tile_absolute_kpa: Floats) -> list[MarkerChange]:
        """Feed readings of the tile; return the changes of markers, in order.

        Args:
            t_ns: (n,), instants, rising from call to call.
            tile_absolute_kpa: (n,), of this tile; NaN without a reading.
        """
        actions: list[MarkerChange] = []
        for at_ns, reading_kpa in zip(t_ns.tolist(), tile_absolute_kpa.tolist(), strict=True):
            if not np.isfinite(reading_kpa):
                continue
            at_s = 1e-9 * at_ns
            if at_s - self._last_s > _GAP_S:
                self._sum, self._count = 0.0, 0
                actions += self._interrupt(f"no readings for {at_s - self._last_s:.1f} s")
            self._last_s = at_s
            if at_s >= self._bin_ends_s:
                if self._count:
                    actions += self._advance(self._sum / self._count, at_ns)
                self._sum, self._count, self._bin_ends_s = 0.0, 0, at_s + _BIN_S
            self._sum, self._count = self._sum + reading_kpa, self._count + 1
        return actions

    def repeat_held_or_last_weight(self) -> list[MarkerChange]:
        """Go back to the weight that is held, or else to the last one, and rest before it.

        Returns:
            Withdrawals of markers.
        """
        reason = "repeated by hand"
        actions: list[MarkerChange] = []
        if self.step in ("resting", "put on", "holding"):
            actions.append(Withdraw(reason))
        if self.step == "holding":
            self._on_kpa = self._in_step[-1] if self._in_step else self._on_kpa
        elif self.held:
            self.held.pop()
            actions.append(Withdraw(reason))
        self.step, self._bins = "empty", []
        return actions

    @property
    def _step_s(self) -> float:
        return HOLD_S if self.step == "holding" else REST_S

    @property
    def _newest_kpa(self) -> float:
        return self.recent_kpa[-1] if self.recent_kpa else np.nan

    def _advance(self, kpa: float, t_ns: int) -> list[MarkerChange]:
        """Go on by a quarter of a second, which ends at this instant."""
        self._bins = [*self._bins[1 - _WINDOW_BINS :], kpa]
        self.recent_kpa.append(kpa)
        match self.step:
            case "empty" if self._is_steady(0.0) and self._is_empty(kpa):
                return self._begin("resting", "rest", t_ns)
            case "put on" if kpa < self.rest_kpa - LOADED_KPA:
                # What looked like a rest was a load, or had not settled.
                self.step = "empty"
                return [Withdraw("the tile was not at rest")]
            case "put on" if self._is_steady(self.rest_kpa) and self._is_loaded(kpa):
                return self._begin("holding", self.weights[self.weight_index], t_ns)
            case "resting" | "holding":
                return self._watch(kpa, t_ns)
            case _:
                return []

    def _begin(self, step: StepName, label: str, t_ns: int) -> list[MarkerChange]:
        self.step, self._in_step = step, []
        return [Begin(f"{self.serial} {label}", t_ns)]

    def _watch(self, kpa: float, t_ns: int) -> list[MarkerChange]:
        is_weight = self.step == "holding"
        zero_kpa = self.rest_kpa if is_weight else 0.0
        self._in_step.append(kpa - zero_kpa)
        first, newest = self._in_step[0], self._in_step[-1]
        self.repeatability = Repeatability(
            mean_kpa=float(np.mean(self._in_step)),
            spread_kpa=float(np.std(self._in_step)),
            settle_kpa=newest - first,
        )
        allowed_kpa = max(_MOVED_KPA, MOVED_PART * first) if is_weight else LOADED_KPA
        if abs(newest - first) > allowed_kpa:
            return self._interrupt(f"the pressure moved by {newest - first:+.2f} kPa")
        if len(self._in_step) * _BIN_S < self._step_s:
            return []
        self._bins = []
        if is_weight:
            self.held.append(self.repeatability)
            self._on_kpa = self.repeatability.mean_kpa
            self.step = "done" if self.weight_index == len(self.weights) else "empty"
        else:
            self.rest_kpa = float(np.mean(self._in_step[-_WINDOW_BINS:]))
            self.step = "put on"
        return [End(t_ns)]

    def _interrupt(self, reason: str) -> list[MarkerChange]:
        """Wait for a steady pressure again; withdraw the step under way."""
        self._bins = []
        if self.step not in ("resting", "holding"):
            return []
        self.step = "put on" if self.step == "holding" else "empty"
        return [Withdraw(reason)]

    def _is_steady(self, zero_kpa: float) -> bool:
        if len(self._bins) < _WINDOW_BINS:
            return False
        level_kpa = abs(self._bins[-1] - zero_kpa) if zero_kpa else 0.0
        return bool(np.ptp(self._bins) < max(_MOVED_KPA, 0.05 * level_kpa))

    def _is_loaded(self, kpa: float) -> bool:
        return kpa > self.rest_kpa + LOADED_KPA

    def _is_empty(self, kpa: float) -> bool:
        """Return whether the last weight is off; its creep goes back slowly."""
        return not self._on_kpa or kpa < self.rest_kpa + max(LOADED_KPA, 0.3 * self._on_kpa)
