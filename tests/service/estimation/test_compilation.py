"""The warm-up compiles all kernels of a stream: no frame waits for a compiler."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import numpy as np
import pytest

import service.estimation
from service.estimation import compilation
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from storage.schema import wire_schema
from storage.wire import decode_message, encode_frames
from tests.builders.calibrations import make_tare
from tests.builders.frames import with_columns


def count_signatures() -> dict[str, int]:
    """Count the compiled signatures of every kernel."""
    found = {}
    for module in pkgutil.walk_packages(service.estimation.__path__, "service.estimation."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if hasattr(value, "signatures"):
                found[f"{value.py_func.__module__}.{name}"] = len(value.signatures)
    return found


@pytest.mark.parametrize(
    "models", [("unwrap", "static"), ("static", "denoise", "skew"), MODEL_NAMES]
)
def test_nothing_is_compiled_after_the_warm_up(
    models: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    def noted(*arguments: Any, **options: Any) -> EstimationPlan:
        made.append(arguments)
        return make_plan(*arguments, **options)

    monkeypatch.setattr(compilation, "make_plan", noted)
    compilation.compile_models()
    before = count_signatures()
    assert before["service.estimation.estimate._step"] == 1
    info, calibration, _ = made[0]
    tare = make_tare(
        3, baseline_kpa=97.0, baseline_sigma_kpa=0.01, noise_kpa=0.1, temperature_raw_counts=507.0
    )
    plan = make_plan(info, calibration, tare, models=models, lag_ms=10.0)
    estimator = ModelEstimator(plan)
    first = compilation._frames()
    for number in range(6):  # as from the wire: read-only views of the message
        later = with_columns(
            first,
            seq=first.seq + np.uint64(number * len(first)),
            t_mono_ns=first.t_mono_ns + 2_000_000 * number * len(first),
        )
        schema = wire_schema(info)
        estimator.process_frames(decode_message(bytes(encode_frames(later, schema)), schema))
    estimator.finish()
    assert count_signatures() == before
