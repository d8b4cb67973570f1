"""Effect of omitted models: models that are offered and not named, and their newtons.

Each such model runs beside the others over the recorded frames. The distance of the GRF from the
GRF without that model is the error of omitting it. All parameters come from the calibration.
`denoise` is left out: it changes no load, and needs most of the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from devices.arrays import Bools
from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.tare.tare import Tare

EFFECT_MIN_N = 0.1
"""Least effect on the GRF that is reported, mean absolute under load."""
REASONS_BY_MODEL: Mapping[str, str] = {
    "temperature": "chips have warmed or cooled since the tare",
    "ambient": "the pressure around the domes has changed",
    "gas": "loads come or go fast",
    "rubber": "loads last",
    "hysteresis": "loads rise and fall",
}
"""Models that are checked, and the reason for naming each."""
_ALL_MODELS = "whole"
_NANONEWTONS = 1e9  # whole nanonewtons add up to the same in any order


class OmittedModelEffect:
    """Effect of omitted models on consecutive frames of one stream.

    Args:
        info: the array.
        calibration: of its tiles.
        models: names of the models in use.
    """

    def __init__(self, info: ArrayInfo, calibration: Calibration, models: Sequence[str]) -> None:
        self._info, self._calibration = info, calibration
        self._named = tuple(name for name in models if name != "denoise")
        self._tare: Tare | None = None
        self._offered: tuple[str, ...] | None = None
        self._estimators: dict[str, ModelEstimator] = {}
        self._sums: dict[str, int] = {}
        self._frames = 0
        self._last_t_mono_ns = 0

    def add_frames(self, tare: Tare, frames: FrameBatch, is_foot_loaded: Bools) -> None:
        """Estimate the next frames with and without the omitted models.

        Args:
            tare: in force.
            frames: n frames, in order, one at least.
            is_foot_loaded: (n,), whether the foot bears load.
        """
        if tare is not self._tare:
            self._start_tare(tare)
        if int(frames.t_mono_ns[0]) < self._last_t_mono_ns:  # the node was switched on again
            self._estimators = {n: ModelEstimator(e.plan) for n, e in self._estimators.items()}
        self._last_t_mono_ns = int(frames.t_mono_ns[-1])
        grf_n = {name: each.process_frames(frames).grf_n for name, each in self._estimators.items()}
        if not grf_n:
            return
        whole_n = grf_n.pop(_ALL_MODELS)
        judged = is_foot_loaded & np.isfinite(whole_n)
        for without_n in grf_n.values():
            judged &= np.isfinite(without_n)
        self._frames += int(judged.sum())
        for name, without_n in grf_n.items():
            off_n = np.abs(without_n - whole_n)[judged]
            self._sums[name] += int(np.rint(_NANONEWTONS * off_n).astype(np.int64).sum())

    def compute_notable_mean_grf_effects_by_model_n(self) -> dict[str, float]:
        """Return mean absolute effects of omitted models, from `EFFECT_MIN_N` on, largest first."""
        if not self._frames:
            return {}
        newtons = {name: total / _NANONEWTONS / self._frames for name, total in self._sums.items()}
        requested = [(n, name) for name, n in newtons.items() if n >= EFFECT_MIN_N]
        return {name: n for n, name in sorted(requested, reverse=True)}

    def _start_tare(self, tare: Tare) -> None:
        self._tare = tare
        if self._offered is None:
            self._offered = tuple(
                name
                for name in REASONS_BY_MODEL
                if name not in self._named and self._is_offered(name, tare)
            )
            self._sums = dict.fromkeys(self._offered, 0)
        if not self._offered:
            return
        every = (*self._named, *self._offered)
        plans = {_ALL_MODELS: self._make_plan(every, tare)}
        for name in self._offered:
            plans[name] = self._make_plan([other for other in every if other != name], tare)
        self._estimators = {name: ModelEstimator(plan) for name, plan in plans.items()}

    def _is_offered(self, name: str, tare: Tare) -> bool:
        try:
            self._make_plan((*self._named, name), tare)
        except FootTileError:
            return False
        return True

    def _make_plan(self, models: Sequence[str], tare: Tare) -> EstimationPlan:
        return make_plan(self._info, self._calibration, tare, models=models)
