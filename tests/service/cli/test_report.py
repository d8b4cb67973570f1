"""Report of a session's stances on the command line."""

from __future__ import annotations

from dataclasses import replace

import pytest

from service.cli.report import format_stances
from service.estimation.stances import Stance

NAN = float("nan")
WHOLE = Stance(
    *(1, 0, 0, 500_000_000, 0.002, 5.0, 20, 0.5, 2.0, 0.1, -0.01, 0.02, 0.03, 0.001),
    *(250, 0, 0, 0.0, 0, True, True),
)
HIDDEN = replace(WHOLE, peak_sigma_n=NAN, gap_s=0.06)
CUT = replace(WHOLE, begun=False, duration_sigma_s=NAN)
NONE = "no medians, as most are cut by gaps or an end of the session"


@pytest.mark.parametrize(
    ("stances", "expected"),
    [
        ([WHOLE], "1 stance: median peak 5.00 N, impulse 2.00 N s, duration 0.50 s"),
        (
            [WHOLE, WHOLE, CUT],
            "3 stances, 2 of them whole: median peak 5.00 N, impulse 2.00 N s, duration 0.50 s",
        ),
        ([WHOLE, CUT], f"2 stances, 1 of them whole: {NONE}"),
        ([WHOLE, *[CUT] * 51], f"52 stances, 1 of them whole: {NONE}"),
        (
            [WHOLE, HIDDEN],
            "2 stances: most peaks are lower bounds, for gaps, median impulse 2.00 N s, "
            "duration 0.50 s",
        ),
    ],
)
def test_medians_are_of_most_stances(stances: list[Stance], expected: str) -> None:
    assert format_stances(stances) == expected
