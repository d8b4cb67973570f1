"""No command ends because of the encoding of its terminal."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOOTTILE = str(Path(sys.executable).parent / "foottile")

# `serve` announces itself on a terminal, with its code for phones.
ANNOUNCE = """
import sys
from pathlib import Path
from service.api.access import Logins
from service.cli import main
from service.cli.commands.serve import print_addresses
main.app = lambda: print_addresses(
    ["http://192.168.4.1:8000"],
    Path("daten-\\u00fc-\\u2603"),
    Logins("a-token-of-this-test"),
    is_stored=True,
)
main.main()
"""


def on_terminal(code: str, folder: Path, **environment: str) -> tuple[int, bytes]:
    """Run Python code on a terminal of 80 columns; return the exit code and all output."""
    ours, its = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "COLUMNS": "80", **environment},
        stdin=subprocess.DEVNULL,
        stdout=its,
        stderr=its,
    )
    os.close(its)
    written = b""
    try:
        while piece := os.read(ours, 1 << 16):
            written += piece
    except OSError:  # the terminal's other end is closed
        pass
    finally:
        os.close(ours)
    return process.wait(60.0), written


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("encoding", ["ascii", "cp437", "utf-8"])
def test_a_server_announces_itself_on_any_terminal(encoding: str, tmp_path: Path) -> None:
    code, written = on_terminal(ANNOUNCE, tmp_path, PYTHONIOENCODING=encoding)
    text = written.decode(encoding)
    assert code == 0, text
    assert "http://192.168.4.1:8000/#token=" in text
    assert "daten-" in text
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in text.splitlines()]
    has_blocks = encoding in ("cp437", "utf-8")
    drawn = [line for line in lines if line and set(line) <= set("█▀▄ " if has_blocks else "# ")]
    assert len(drawn) > 15


@pytest.mark.slow
@pytest.mark.process
def test_a_narrow_terminal_gets_a_hint_instead_of_the_code(tmp_path: Path) -> None:
    code, written = on_terminal(ANNOUNCE, tmp_path, COLUMNS="20", PYTHONIOENCODING="utf-8")
    assert code == 0
    assert "█" not in written.decode()
    assert "columns" in written.decode()


@pytest.mark.process
def test_a_name_outside_the_encoding_is_escaped(tmp_path: Path) -> None:
    done = subprocess.run(
        [FOOTTILE, "verify", str(tmp_path / "f\u00fc\u00df-\u2603.parquet")],
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
        capture_output=True,
    )
    assert done.returncode in (1, 2), done.stderr
    assert b"Traceback" not in done.stderr
    assert b"\\u2603" in done.stdout + done.stderr
