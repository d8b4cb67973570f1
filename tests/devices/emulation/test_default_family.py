"""The default family of parts stays what it is: calibrations and results are made with it.

The digests were taken from the emulator as it was before there was another family.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import pytest

from devices.emulation.parts import draw_chip, draw_dome
from devices.scene.scene_file import load_scene
from tests.devices.feet import foot

SHELVES = [(serial, seed) for seed in range(5) for serial in ("T01", "T02", "T07", "S-3")]


def digest(rows: Sequence[tuple[float, ...]]) -> str:
    """Of numbers to twelve digits: the last one of an exponential may differ between machines."""
    text = "\n".join(" ".join(f"{number:.12g}" for number in row) for row in rows)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def test_its_chips_are_drawn_as_ever() -> None:
    chips = [draw_chip(serial, seed) for serial, seed in SHELVES]
    rows = [
        (*chip.coefficients.to_words(), chip.conversion_ns, chip.tadc_at_25_degc) for chip in chips
    ]
    assert digest(rows) == "766e815c8ff4fdb5"


def test_its_domes_are_drawn_as_ever() -> None:
    domes = [draw_dome(serial, seed) for serial, seed in SHELVES]
    rows = [
        (
            dome.seal_kpa,
            dome.knee_n,
            dome.stiffening,
            dome.wall_per_kpa,
            dome.conduction_s,
            dome.gas_lag_s,
            dome.chip_lag_s,
            *dome.creep_parts,
            *dome.creep_s,
            dome.loop_n,
        )
        for dome in domes
    ]
    assert digest(rows) == "8d40fa7f9509e9e5"


@pytest.mark.parametrize(
    ("name", "seconds", "expected"),
    [
        ("rolling", 1.0, "d991be8eb209677b"),
        ("mud", 1.0, "07d09f5225a6f1ea"),
        ("indentation", 4.0, "23c77ffc4ccbdf41"),
    ],
)
def test_its_counts_are_bit_for_bit_what_they_were(
    name: str, seconds: float, expected: str
) -> None:
    frames = foot(load_scene(name)).run_for(seconds)
    read = np.stack([frames.pressure_raw, frames.temperature_raw]).astype("<u2")
    assert hashlib.sha256(read.tobytes()).hexdigest()[:16] == expected
