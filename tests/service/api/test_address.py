"""Where a server is found is known before there is one."""

from __future__ import annotations

import subprocess
import sys


def test_where_a_server_will_be_is_known_without_importing_what_it_is_made_of() -> None:
    # `foottile demo` starts its node by it, which looks for its tiles while the server is prepared.
    code = (
        "import sys, service.api.address, service.cli.commands.demo\n"
        "print([name for name in ('fastapi', 'uvicorn', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
