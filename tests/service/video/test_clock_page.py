"""Clock page: its cells, its picture, and the server's time of a film that shows it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from service.video import clock_page
from service.video.clock_page import ClockReading, decode_cells, encode_cells

VECTORS = Path(__file__).with_name("clock_page.json")
"""Layout and examples, which the test of the page's script reads, too."""


def make_layout() -> dict[str, object]:
    """The layout that `web/clock/` draws."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tags = []
    for number, corner in clock_page.TAGS.items():
        squares = cv2.aruco.generateImageMarker(dictionary, number, clock_page.TAG_UNITS)
        rows = ["".join("0" if v else "1" for v in row) for row in squares.tolist()]
        tags.append({"id": number, "at": list(corner), "black": rows})
    moments = [
        (0, 0, 1),
        (1_764_268_887_123_456_789, 3, 17),
        (1_764_268_887_146_456_789, 3, 17),
        (2**32 * clock_page.TICK_NS - 1_000_000, 62, 23),
        (2**32 * clock_page.TICK_NS + 31 * clock_page.TICK_NS, 1, 9),
        (1_900_000_000_000_000_000, 63, 63),
    ]
    return {
        "tick_ns": clock_page.TICK_NS,
        "units": list(clock_page.UNITS),
        "tags": tags,
        "cell_units": clock_page.CELL_UNITS,
        "cells_at": list(clock_page.CELLS_AT),
        "cells_per_row": clock_page.CELLS_PER_ROW,
        "unknown_ms": clock_page.UNKNOWN_MS,
        "examples": [
            {
                "t_ms": t_ns / 1e6,
                "bound_ms": bound_ms,
                "refresh_ms": refresh_ms,
                "cells": encode_cells(
                    ClockReading(t_ns // clock_page.TICK_NS % 2**32, bound_ms, refresh_ms)
                ),
            }
            for t_ns, bound_ms, refresh_ms in moments
        ],
    }


def test_the_layout_that_the_page_draws_is_that_of_the_decoder() -> None:
    assert json.loads(VECTORS.read_text("utf-8")) == make_layout()


def test_a_reading_comes_back_and_a_wrong_cell_is_refused_or_one_of_the_last_six_bits() -> None:
    generator = np.random.default_rng(1)
    for _ in range(50):
        n = int(generator.integers(2**32))
        bound_ms, refresh_ms = int(generator.integers(63)), int(generator.integers(1, 24))
        reading = ClockReading(n, bound_ms, refresh_ms)
        cells = encode_cells(reading)
        assert len(cells) == clock_page.CELLS
        assert decode_cells(cells) == reading
        after = encode_cells(reading._replace(n=(n + 1) % 2**32))
        assert sum(a != b for a, b in zip(cells[24:], after[24:], strict=True)) == 1
        for k in range(clock_page.CELLS):
            wrong = decode_cells(cells[:k] + str(1 - int(cells[k])) + cells[k + 1 :])
            assert wrong is None or (k >= clock_page.CELLS - 6 and abs(wrong.n - n) < 64)
    assert decode_cells("0" * clock_page.CELLS) is None
    assert decode_cells("1" * clock_page.CELLS) is None
    for unknown in (ClockReading(9, 63, 16), ClockReading(9, 1, 63), ClockReading(9, 1, 30)):
        assert decode_cells(encode_cells(unknown)) is None


TRUE_NS = 1_764_268_887_000_000_000
"""The server's UTC at the first picture of films."""


def draw_page(reading: ClockReading, unit_px: int = 12) -> npt.NDArray[np.uint8]:
    """The page on a screen, with some of the white around it."""
    width, height = clock_page.UNITS
    units = np.full((height, width), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    size = clock_page.TAG_UNITS
    for number, (x, y) in clock_page.TAGS.items():
        units[y : y + size, x : x + size] = cv2.aruco.generateImageMarker(dictionary, number, size)
    left, top = clock_page.CELLS_AT
    size = clock_page.CELL_UNITS
    for k, cell in enumerate(encode_cells(reading)):
        x = left + k % clock_page.CELLS_PER_ROW * size
        y = top + k // clock_page.CELLS_PER_ROW * size
        units[y : y + size, x : x + size] = 0 if cell == "1" else 255
    return np.kron(units, np.ones((unit_px, unit_px), np.uint8))


@dataclass(frozen=True)
class Screen:
    """A screen whose picture changes each refresh, and is lit a latency later."""

    refresh_ns: float
    phase: float
    latency_ns: float
    page_off_ns: float = 0.0
    """Error of the page's offset to the server's clock."""
    true_ns: int = TRUE_NS
    """The server's UTC at instant 0."""

    def get_tick(self, t_ns: float) -> int:
        """The tick that is lit at an instant."""
        refreshes = math.floor((t_ns - self.latency_ns) / self.refresh_ns - self.phase)
        drawn_ns = (refreshes + self.phase) * self.refresh_ns
        return (self.true_ns + round(drawn_ns + self.page_off_ns)) // clock_page.TICK_NS


def film_screen(
    screen: Screen, begin_ns: float, exposure_ns: float, generator: np.random.Generator
) -> npt.NDArray[np.uint8]:
    """A picture of the screen at an angle, blurred, shaded, exposed over some time."""
    lit = []
    for part in np.linspace(0.0, 1.0, 9):
        n = screen.get_tick(begin_ns + part * exposure_ns) % 2**32
        lit.append(draw_page(ClockReading(n, 3, 17)).astype(np.float64))
    page = np.mean(lit, axis=0)
    height, width = page.shape
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32)
    seen = np.array([(120, 110), (500, 60), (540, 300), (90, 330)], np.float32)
    matrix = cv2.getPerspectiveTransform(corners, seen)
    picture = cv2.warpPerspective(page * 0.7 + 10.0, matrix, (640, 400), borderValue=(60.0,))
    blurred = cv2.GaussianBlur(picture * np.linspace(0.6, 1.0, 640), (5, 5), 1.2)
    noisy = blurred + generator.normal(0.0, 3.0, picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("exposure_ns", [1e6, 33e6])
def test_the_page_is_read_at_an_angle_with_blur_shade_and_a_long_exposure(
    exposure_ns: float,
) -> None:
    generator = np.random.default_rng(3)
    screen = Screen(1e9 / 60, 0.3, 0.0)
    read = clock_page.make_clock_reader()
    readings = []
    for k in range(24):
        begin_ns = k * 33_366_700.0
        reading = read(film_screen(screen, begin_ns, exposure_ns, generator))
        if reading is not None:
            readings.append(reading)
            assert abs(reading.n - screen.get_tick(begin_ns + exposure_ns / 2) % 2**32) <= 1
            assert reading[1:] == (3, 17)
    assert len(readings) >= 20
    assert read(np.full((400, 640), 200, np.uint8)) is None


@pytest.mark.parametrize("rate_hz", [30.0, 50.0, 240.0])
def test_the_uncertainty_of_a_run_is_that_of_many_screens(rate_hz: float) -> None:
    generator = np.random.default_rng(round(rate_hz))
    ratios = []
    for _ in range(200):
        refresh_ns = 1e9 / float(generator.choice([50.0, 60.0, 90.0, 120.0]))
        screen = Screen(
            refresh_ns,
            generator.random(),
            refresh_ns * generator.uniform(1.0, 3.0) + generator.uniform(5e6, 15e6),
            generator.uniform(-2e6, 2e6),
        )
        film_s = np.arange(round(2.0 * rate_hz)) / rate_hz
        true_ns = 1e9 * film_s + generator.uniform(0.0, 1e9)
        readings = [
            ClockReading(screen.get_tick(t) % 2**32, 2, math.ceil(refresh_ns / 1e6))
            for t in true_ns.tolist()
        ]
        readings[7] = readings[7]._replace(n=readings[7].n + 40)  # a cell was wrong
        (pair,) = clock_page.find_clock_pairs(film_s, readings, TRUE_NS + 10**15)
        off_ns = pair.t_ns - TRUE_NS - (true_ns[0] + 1e9 * (pair.film_s - film_s[0]))
        ratios.append(off_ns / math.hypot(pair.sigma_ns, pair.common_ns))
        assert pair.picture_count == len(film_s) - 1
    assert 0.90 <= np.mean(np.abs(ratios) < 1.96) <= 0.99
