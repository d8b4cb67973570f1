"""The report says what was not measured, and draws only what was."""

from __future__ import annotations

import numpy as np
import pytest

from studies.reproduce import experiments as paper
from studies.reproduce.figures import draw_figures
from studies.reproduce.report import ONE_FOOT, format_reproduction_report
from studies.reproduce.result import Reproduction


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
        seconds={"mill": 1.0},
    )


def test_a_run_of_which_everything_failed_says_so_and_draws_nothing() -> None:
    result = nothing(mill="no curve", poppy="the node has ended")
    text = format_reproduction_report(result)
    assert "## Not measured" in text
    assert "- poppy: the node has ended" in text
    assert ONE_FOOT in text
    assert "Table I" not in text
    assert draw_figures(result) == {}
    assert result.as_dict()["failures"] == {"mill": "no curve", "poppy": "the node has ended"}


def test_equation_2_is_compared_by_its_shape_only() -> None:
    output = np.array([0.0, 0.5, 1.0])
    low, middle, high = paper.compute_normalised_force(output)
    assert (low, high) == (0.0, 1.0)
    # hardware.md 7: F(p) - F(0) over F(1) - F(0), by hand.
    by_hand = (0.13 * 0.125 + 0.02354 * 0.25 + 0.5702 * 0.5) / (0.13 + 0.02354 + 0.5702)
    assert middle == pytest.approx(by_hand)
