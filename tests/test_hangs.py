"""What hangs beyond pytest-timeout's reach ends, too, and is named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [pytest.mark.process, pytest.mark.slow]
HANGS = {
    "as a test is ended": """
        def test_hangs():
            try:
                Event().wait()
            finally:
                Event().wait()
        """,
    "in a fixture of a failed test": """
        @pytest.fixture
        def which_hangs():
            yield
            Event().wait()

        def test_fails(which_hangs):
            assert 0
        """,
    "in native code": """
        def test_hangs():
            lock, libc = ctypes.create_string_buffer(64), ctypes.CDLL(None)
            libc.pthread_mutex_lock(lock)
            libc.pthread_mutex_lock(lock)
        """,
    "at exit": """
        def which_hangs():
            Event().wait()

        def test_leaves_a_thread():
            Thread(target=which_hangs).start()
        """,
}


@pytest.mark.parametrize("where", HANGS)
def test_a_hang_ends_the_run_with_a_trace_that_names_it(where: str, tmp_path: Path) -> None:
    file = tmp_path / "test_hang.py"
    imports = "import ctypes\nfrom threading import Event, Thread\nimport pytest\n"
    file.write_text(imports + dedent(HANGS[where]))
    options = ("-c", ROOT / "pyproject.toml", "-p", "tests.conftest", "-p", "no:cacheprovider")
    times = ("-o", "timeout=1", "-o", "faulthandler_timeout=2")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *times, file],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert f'"{file}"' in done.stderr
    assert "_hangs" in done.stderr
