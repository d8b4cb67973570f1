"""Arrays that were never wired: facts of tiles and of the array, and whatever a test changes.

The chips have b1 = -2 and neither b2 nor c12, so a count is 130/1023 kPa (data sheet eq. 1 and 2)
whatever the temperature, and 500 counts are 100.0049 kPa.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from devices.frames import ArrayInfo, ServoInfo, TileInfo

PERIOD_NS = 2_000_000
UTC_NS = 10**18
"""`t_ns` minus `t_mono_ns` of every frame, unless a test wants another."""
COUNT_KPA = 130 / 1023
UNLOADED_COUNTS = 500
UNLOADED_KPA = 787 * 65 / 1023 + 50
NEWTON_CHIP = (1787 * 8, 0xC000, 0, 0)
DATA_SHEET_CHIP = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)
"""The example of data sheet section 3.6."""
FORUM_CHIP = (0x3591, 0xC0A2, 0xC625, 0x2C18)
"""Another part, as someone read it out of their own."""


def make_tile(number: int = 0, **facts: Any) -> TileInfo:
    """The tile with this number from 0: T01, T02 and so on, in a line, eight behind a mux."""
    content: dict[str, Any] = {
        "serial": f"T{number + 1:02}",
        "mux": 0x70 + number // 8,
        "channel": number % 8,
        "chip": "mpl115a2",
        "address": 0x60,
        "registers": NEWTON_CHIP,
        "x_m": 0.014 * number,
        "y_m": 0.0,
        "z_m": -0.15,
        "reference": False,
        "conversion_ms": 1.6,
    }
    return TileInfo(**content | facts)


def make_servo(**facts: Any) -> ServoInfo:
    """A servo whose angle is the segment's, in a foot that rolls over an arc of 150 mm."""
    content: dict[str, Any] = {
        "model": "MX-28",
        "counts_per_turn": 4096,
        "zero_counts": 2048,
        "sign": 1,
        "ratio": 1.0,
        "ankle_travel_m_per_rad": 0.15,
    }
    return ServoInfo(**content | facts)


def make_array(tiles: int | Sequence[TileInfo] = 2, **facts: Any) -> ArrayInfo:
    """An array of so many tiles, or of these."""
    if isinstance(tiles, int):
        tiles = [make_tile(number) for number in range(tiles)]
    content: dict[str, Any] = {
        "node": "bench",
        "stream_id": "0" * 32,
        "tiles": tuple(tiles),
        "servo": None,
        "schedule": "simultaneous",
        "nominal_rate_hz": 1e9 / PERIOD_NS,
        "utc_offset_ns": UTC_NS,
        "clock_set": True,
        "software": "test",
        "scene": "test",
        "models": ("unwrap", "static"),
    }
    return ArrayInfo(**content | facts)


def array_at(
    positions_m: Sequence[tuple[float, float, float]],
    *,
    references: Sequence[int] = (),
    chips: Sequence[tuple[int, int, int, int]] | None = None,
    **facts: Any,
) -> ArrayInfo:
    """An array with tiles at these positions, some of them reference tiles."""
    tiles = [
        make_tile(
            i,
            x_m=x_m,
            y_m=y_m,
            z_m=z_m,
            reference=i in references,
            registers=chips[i] if chips else NEWTON_CHIP,
        )
        for i, (x_m, y_m, z_m) in enumerate(positions_m)
    ]
    return make_array(tiles, **facts)
