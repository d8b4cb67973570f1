"""What several tests of storage need: an array, and frames of its one stream."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from devices.frames import FRAME_COLUMNS, ArrayInfo, FrameBatch, TileInfo
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode

PERIOD_NS = 2_000_000
UTC_NS = 10**18


@pytest.fixture(scope="session")
def array_of() -> Callable[..., ArrayInfo]:
    """An array; `array_of(boot_id="1" * 32)` is that of another stream."""

    def build(tiles: int = 2, **facts: Any) -> ArrayInfo:
        content: dict[str, Any] = {
            "node": "bench",
            "boot_id": "0" * 32,
            "tiles": tuple(
                TileInfo(
                    serial=f"T{i + 1:02}",
                    mux=0x70,
                    channel=i,
                    coefficient_words=(0x3ECE, 0xB3F9, 0xC517, 0x33C8),
                    x_m=0.014 * i,
                    y_m=0.0,
                    z_m=-0.15,
                    reference=False,
                    conversion_ms=1.6,
                )
                for i in range(tiles)
            ),
            "servo": None,
            "schedule": "simultaneous",
            "nominal_rate_hz": 1e9 / PERIOD_NS,
            "utc_offset_ns": UTC_NS,
            "clock_set": True,
            "software": "test",
            "scene": "test",
            "models": ("unwrap", "static"),
        }
        return ArrayInfo(**(content | facts))

    return build


@pytest.fixture(scope="session")
def frames_of() -> Callable[..., FrameBatch]:
    """Frames `first` to `last` of a stream; counts depend on the number only."""

    def build(first: int, last: int, tiles: int = 2) -> FrameBatch:
        seq = np.arange(first, last + 1, dtype=np.uint64)
        n = len(seq)
        t_mono_ns = (seq.astype(np.int64) + 1) * PERIOD_NS
        columns: dict[str, Any] = {
            name: np.zeros((n, tiles) if per_tile else n, dtype)
            for name, (dtype, per_tile) in FRAME_COLUMNS.items()
        }
        columns |= {"seq": seq, "t_mono_ns": t_mono_ns, "t_ns": t_mono_ns + UTC_NS}
        columns["padc"] = (
            500 + (seq[:, None] * 7 + np.arange(tiles, dtype=np.uint64)) % 97
        ).astype(np.uint16)
        columns["tadc"] = np.full((n, tiles), 480, np.uint16)
        columns["reference_force_n"] = np.full(n, np.nan, np.float32)
        return FrameBatch(**columns)

    return build


@pytest.fixture(scope="session")
def batch_of(
    array_of: Callable[..., ArrayInfo], frames_of: Callable[..., FrameBatch]
) -> Callable[..., EncodedBatch]:
    """The same frames as a node's message."""

    def build(first: int, last: int) -> EncodedBatch:
        frames = frames_of(first, last)
        return EncodedBatch.of(frames, encode(frames, wire_schema(array_of())))

    return build
