"""Frames that were never taken, for tests of the harness itself."""

from __future__ import annotations

import numpy as np

from devices.frames import ArrayInfo, FrameBatch, TileInfo


def info_of(boot_id: str) -> ArrayInfo:
    return ArrayInfo(
        node="foot",
        boot_id=boot_id,
        tiles=(
            TileInfo(
                serial="T01",
                mux=0x70,
                channel=0,
                coefficient_words=(1, 2, 3, 4),
                x_m=0.0,
                y_m=0.0,
                z_m=0.0,
                reference=False,
                conversion_ms=1.6,
            ),
        ),
        servo=None,
        schedule="simultaneous",
        nominal_rate_hz=100.0,
        utc_offset_ns=0,
        clock_set=True,
        software="test",
        scene="test",
        models=("static",),
    )


def batch(first: int, count: int) -> FrameBatch:
    seq = np.arange(first, first + count, dtype=np.uint64)
    tiles = np.repeat(seq.astype(np.uint16)[:, None] % 1000, 1, axis=1)
    return FrameBatch(
        seq=seq,
        t_mono_ns=seq.astype(np.int64) * 10_000_000,
        t_ns=seq.astype(np.int64) * 10_000_000,
        padc=tiles,
        tadc=tiles,
        sample_offset_us=tiles.astype(np.int32),
        servo_counts=np.zeros(count, np.int32),
        servo_age_us=np.zeros(count, np.int32),
        status=tiles.astype(np.uint8),
        frame_status=np.zeros(count, np.uint8),
        reference_force_n=np.full(count, np.nan, np.float32),
    )
