"""Nothing that the harness has started outlives it, even if it is killed itself.

FAULTS_PARENT is the number of the process whose end this one's is to be; not that of its children,
which end with it as they do in real life.
"""

from __future__ import annotations

import ctypes
import os
import signal

PARENT_ENV = "FAULTS_PARENT"
_PR_SET_PDEATHSIG = 1


def install_from_environment() -> None:
    """End with the parent if this process is the one that was meant."""
    if os.environ.get(PARENT_ENV) == str(os.getppid()):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
