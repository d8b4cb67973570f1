"""Recordings in pieces, and their estimates."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.sessions.estimate_stream import EstimateOptions, EstimateStream
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.calibrations import make_calibration, newton_tile
from tests.builders.frames import loaded_frames

Piece = tuple[FrameBatch, dict[str, np.ndarray]]


def array(rate_hz: float = 500.0) -> ArrayInfo:
    return make_array(nominal_rate_hz=rate_hz)


def calibration(*serials: str, **changes: Any) -> Calibration:
    entry = {
        "coefficients": (0.0, 1.0, 0.001, 0.0),
        "covariance": ((1e-4, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-9)),
        "relative_misfit": 0.01,
    }
    return make_calibration(*(newton_tile(s, **entry | changes) for s in serials or ("T01", "T02")))


def options(**changes: Any) -> EstimateOptions:
    chosen: dict[str, Any] = {
        "calibration": calibration(),
        "models": ("unwrap", "static"),
        "lag_ms": 10.0,
        "unquantized": True,
    }
    return EstimateOptions(**chosen | changes)


def frames(
    forces_n: np.ndarray, *, lead: int = 0, period_ns: int = PERIOD_NS, **columns: Any
) -> FrameBatch:
    status = np.where(np.arange(len(forces_n)) < lead, FrameFlag.LEAD, 0)
    return loaded_frames(forces_n, period_ns=period_ns, frame_flags=status, **columns)


def hopping(n: int, *, loaded_from: int, seed: int = 0) -> np.ndarray:
    """Noise, and from frame `loaded_from` on hops of 30 ms, for two tiles."""
    rng = np.random.default_rng(seed)
    at = np.arange(n)
    load = np.where((at >= loaded_from) & (at // 15 % 2 == 1), 20.0, 0.0)
    return load[:, None] + rng.normal(0.0, 1.0, (n, 2))


def cut(batch: FrameBatch, cuts: Sequence[int]) -> list[Piece]:
    """The batch in pieces, each with an extra column that tells its frames apart."""
    edges = [0, *sorted(set(cuts) & set(range(1, len(batch)))), len(batch)]
    return [
        (batch.slice_rows(a, b), {"true_grf_n": 1000.0 + np.arange(a, b)})
        for a, b in pairwise(edges)
    ]


def run(
    pieces: Sequence[Piece], info: ArrayInfo | None = None, **changes: Any
) -> tuple[EstimateStream, FrameBatch, dict[str, np.ndarray]]:
    stream = EstimateStream(info or array(), options(**changes))
    out = list(stream.estimate_batches(pieces))
    for batch, columns in out:
        assert {len(values) for values in columns.values()} == {len(batch)}
    columns = {name: np.concatenate([c[name] for _, c in out]) for name in out[0][1]}
    return stream, FrameBatch.concatenate([batch for batch, _ in out]), columns


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert list(one) == list(other)
    for name, values in one.items():
        assert values.tobytes() == other[name].tobytes(), name
