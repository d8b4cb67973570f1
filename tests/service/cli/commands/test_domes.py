"""`foottile domes`: one dome for a load, and what is known of it."""

from __future__ import annotations

import json

from tests.service.cli.outcome import Run


def test_domes_names_one_for_a_load_and_marks_estimates(run: Run) -> None:
    outcome = run("domes", "--load-n", 24)
    assert outcome.code == 0
    assert "For 24 N: v60-11 (paper)." in outcome.out
    assert outcome.out.count("estimate ") >= 5
    assert run("domes", "--load-n", 50).code == 3
    assert run("domes", "--load-n", -1).code == 2
    printed = json.loads(run("domes", "--load-n", 30, "--json").out)
    assert (printed["dome"], printed["verdict"]) == ("v60-11", "perhaps")
