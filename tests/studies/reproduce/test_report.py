"""The report says what was not measured, and draws only what was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from studies.reproduce import experiments as paper
from studies.reproduce.figures import draw_figures
from studies.reproduce.report import ONE_FOOT, format_reproduction_report
from studies.reproduce.result import Reproduction
from studies.reproduce.video_angle import AngleComparison


def nothing(**failures: str) -> Reproduction:
    return Reproduction(
        software="foottile",
        run_at="2026-01-01",
        seed=0,
        is_shortened=False,
        domes=(),
        calibration=None,
        experiments=(),
        not_borne_n={},
        failures=failures,
        seconds={"indenter": 1.0},
    )


def test_a_run_of_which_everything_failed_says_so_and_draws_nothing() -> None:
    result = nothing(indenter="no curve", poppy="the node has ended")
    text = format_reproduction_report(result)
    assert "## Not measured" in text
    assert "- poppy: the node has ended" in text
    assert ONE_FOOT in text
    assert "Table I" not in text
    assert draw_figures(result) == {}
    assert result.as_dict()["failures"] == {"indenter": "no curve", "poppy": "the node has ended"}


def test_the_films_angle_is_reported_beside_the_servos() -> None:
    angles = AngleComparison(
        pictures=326,
        rate_hz=50.0,
        angle_rms_rad={"servo": 1e-4, "video": 5e-4},
        angle_most_rad={"servo": 1e-3, "video": 2e-3},
        cop_rms_m={"servo": 2.096e-4, "video": 2.095e-4},
        cop_apart_m=5e-7,
    )
    result = replace(nothing(), angles=angles)
    text = format_reproduction_report(result)
    assert "326 pictures at 50 a second" in text
    assert "| video | 0.029, 0.115 | 0.2095 |" in text
    assert result.as_dict()["angles"] == angles
    assert "angles" not in nothing().as_dict()


def test_equation_2_is_compared_by_its_shape_only() -> None:
    output = np.array([0.0, 0.5, 1.0])
    low, middle, high = paper.compute_normalised_force(output)
    assert (low, high) == (0.0, 1.0)
    # hardware.md 7: F(p) - F(0) over F(1) - F(0), by hand.
    by_hand = (0.13 * 0.125 + 0.02354 * 0.25 + 0.5702 * 0.5) / (0.13 + 0.02354 + 0.5702)
    assert middle == pytest.approx(by_hand)
