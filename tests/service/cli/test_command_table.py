"""The table of commands says what the commands say, without loading them."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from service.cli import commands
from service.cli.main import SUMMARIES, get_command_function
from tests.service.cli.outcome import Run


@pytest.mark.parametrize("name", SUMMARIES)
def test_a_summary_is_the_first_sentence_of_its_command(name: str) -> None:
    said = inspect.getdoc(get_command_function(name))
    assert said is not None
    assert said.replace("\n", " ").startswith(SUMMARIES[name])
    assert SUMMARIES[name].endswith(".")
    assert SUMMARIES[name][:-1].count(". ") == 0


def test_every_command_that_is_written_is_in_the_table() -> None:
    folder = Path(inspect.getfile(commands)).parent
    written = {
        line.removeprefix("def ").split("_command(")[0].replace("_", "-")
        for path in folder.glob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith("def ") and "_command(" in line
    }
    assert written == set(SUMMARIES)


def test_the_help_of_all_names_each_with_its_summary_and_that_of_one_is_its_own(run: Run) -> None:
    said = run("--help").out
    for name, summary in SUMMARIES.items():
        assert f"  {name} " in said
        assert summary[:30] in said
    assert "--family" in run("benchmark", "--help").out


def test_a_name_that_is_nearly_one_is_answered_with_that(run: Run) -> None:
    outcome = run("serv")
    assert outcome.code == 2
    assert "Did you mean 'serve'?" in outcome.err
