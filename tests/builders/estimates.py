"""Plans and estimates of a foot whose tiles read one newton a count."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import TileCalibration
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.records import Estimates
from tests.builders.arrays import COUNT_KPA
from tests.builders.calibrations import make_calibration, make_tare


def newton_plan(
    info: ArrayInfo,
    *,
    sigma_n: float = 0.5,
    lag_ms: float = 0.0,
    models: Sequence[str] = ("unwrap", "static"),
    tiles: Sequence[TileCalibration] | None = None,
) -> EstimationPlan:
    """A plan for an array, tared at 500 counts, with `sigma_n` of noise on every tile."""
    tare = make_tare(len(info.tiles), noise_kpa=sigma_n * COUNT_KPA)
    calibration = make_calibration(*(info.serials if tiles is None else tiles))
    return make_plan(info, calibration, tare, models=models, lag_ms=lag_ms)


def with_params(
    plan: EstimationPlan, *, foot: Mapping[str, Any] | None = None, **tiles: Any
) -> EstimationPlan:
    """A plan with other parameters of the foot, and of all its tiles."""
    params = plan.params._replace(
        foot=copy.copy(plan.params.foot), tiles=copy.copy(plan.params.tiles)
    )
    for name, value in (foot or {}).items():
        params.foot[name] = value
    for name, value in tiles.items():
        params.tiles[name] = value
    return replace(plan, params=params)


def estimate(plan: EstimationPlan, *batches: FrameBatch) -> Estimates:
    """All estimates of these batches, stepped through one after the other."""
    estimator = ModelEstimator(plan)
    pieces = [estimator.process_frames(batch) for batch in batches]
    last = estimator.finish()
    return joined(pieces if last is None else [*pieces, last])


def joined(pieces: Sequence[Estimates]) -> Estimates:
    """One piece of all."""
    return Estimates(
        **{f.name: np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(Estimates)}
    )
