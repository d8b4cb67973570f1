"""What every process of ours does about memory, each time in a process of its own."""

from __future__ import annotations

import subprocess
import sys


def _said(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()[-1]


def test_arrow_takes_the_memory_of_every_command_from_the_system() -> None:
    code = """
import sys
from service.cli.main import main
sys.argv = ["foottile", "--version"]
try:
    main()
except SystemExit:
    pass
import pyarrow
print(pyarrow.default_memory_pool().backend_name)
"""
    assert _said(code) == "system"


def test_a_command_that_asks_for_nothing_more_does_not_load_arrow() -> None:
    code = """
import sys
import service.cli.main
from service.cli.main import use_system_allocator
use_system_allocator()
print("pyarrow" in sys.modules)
"""
    assert _said(code) == "False"
