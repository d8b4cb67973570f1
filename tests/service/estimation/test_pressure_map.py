"""The array as a picture."""

from __future__ import annotations

import numpy as np
import pytest

from devices.errors import UsageError
from service.estimation.pressure_map import pressure_map

LINE = np.array([(-0.021, 0.0), (-0.007, 0.0), (0.007, 0.0), (0.021, 0.0)])
SQUARE = np.array([(0.0, 0.0), (0.01, 0.0), (0.0, 0.02), (0.01, 0.02)])


def test_four_tiles_in_a_line_are_the_papers_3_by_50_matrix() -> None:
    picture = pressure_map(LINE, np.array([[1.0, 2.0, 4.0, 3.0]]))
    assert picture.shape == (1, 3, 50)
    assert (picture[0] == picture[0, 0]).all(), "a line says nothing of what is beside it"
    assert (picture[0, 0, 0], picture[0, 0, -1]) == (1.0, 3.0)
    assert picture.max() <= 4.0
    # Halfway between the second tile and the third
    assert np.interp(0.0, np.linspace(-0.021, 0.021, 50), picture[0, 0]) == pytest.approx(3.0)


def test_the_order_of_tiles_does_not_matter() -> None:
    kpa = np.array([[1.0, 2.0, 4.0, 3.0]])
    order = [2, 0, 3, 1]
    np.testing.assert_array_equal(pressure_map(LINE[order], kpa[:, order]), pressure_map(LINE, kpa))


def test_a_grid_is_spread_both_ways() -> None:
    picture = pressure_map(SQUARE, np.array([[0.0, 1.0, 2.0, 3.0]]), rows=3, columns=3)
    np.testing.assert_allclose(picture[0], [[0.0, 0.5, 1.0], [1.0, 1.5, 2.0], [2.0, 2.5, 3.0]])


def test_a_silent_tile_is_no_number_as_far_as_the_tiles_beside_it() -> None:
    picture = pressure_map(LINE, np.array([[1.0, np.nan, 4.0, 3.0]]), columns=7)
    np.testing.assert_array_equal(
        np.isnan(picture[0, 0]), [False, True, True, True, False, False, False]
    )


def test_a_single_tile_fills_the_picture() -> None:
    assert (pressure_map(LINE[:1], np.array([[5.0]])) == 5.0).all()


def test_tiles_that_fill_no_grid_are_refused() -> None:
    with pytest.raises(UsageError, match="neither a line nor a grid"):
        pressure_map(SQUARE[:3], np.zeros((1, 3)))
