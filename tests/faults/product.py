"""What the commands under test can do by now, asked of themselves.

The one place to look at when commands or options change: what is not there yet is not asked for,
and what it promises is not expected.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.waiting import PATIENCE_S

REPOSITORY = Path(__file__).parents[2]
NODE = "foot"
"""What the node is called."""

_START = "from service.cli.main import main; main()"


@dataclass(frozen=True)
class Product:
    """What there is.

    Attributes:
        node_journal: `foottile node --journal DIR`: the node keeps its frames on disk, so that a
            kill loses nothing and a power cut not more than it says.
        node_record: `foottile node --record NAME`: it records without a server.
        verify: `foottile verify DIR`.
        recover: `foottile recover DIR`.
    """

    node_journal: bool
    node_record: bool
    verify: bool
    recover: bool


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


@cache
def product() -> Product:
    """Ask it once."""
    commands, node = _help(), _help("node")
    return Product(
        node_journal="--journal" in node,
        node_record="--record" in node,
        verify=" verify " in commands,
        recover=" recover " in commands,
    )


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


def _help(*arguments: str) -> str:
    asked = run_command(*arguments, "--help", COLUMNS="200")
    asked.check_returncode()
    return asked.stdout
