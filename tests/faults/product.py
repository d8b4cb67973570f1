"""The commands under test: how they are started, and in which environment."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.waiting import PATIENCE_S

REPOSITORY = Path(__file__).parents[2]
NODE = "foot"
"""What the node is called."""

_START = "from service.cli.main import main; main()"


def command(*arguments: object) -> list[str]:
    """A command line of the product, run by this Python."""
    return [sys.executable, "-c", _START, *map(str, arguments)]


def clean_environment() -> dict[str, str]:
    """This environment, without what would change how the product behaves."""
    return {
        name: value
        for name, value in os.environ.items()
        # Without compiled files each start takes seconds longer.
        if name != "PYTHONDONTWRITEBYTECODE" and not name.startswith(("FOOTTILE_", "FAULTS_"))
    }


def run_command(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run it to its end; what it says is kept."""
    return subprocess.run(
        command(*arguments),
        cwd=REPOSITORY,
        env={**clean_environment(), **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


def hand_over(file: Path, text: str) -> None:
    """Have a running process see this text in a file, whole."""
    temporary = file.with_name(file.name + ".new")
    temporary.write_text(text)
    temporary.replace(file)
