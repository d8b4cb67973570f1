"""Requests to the kernel. A refusal is no failure."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

from devices import realtime

PR_GET_TIMERSLACK = 30


def run_in_a_thread(body: Callable[[], object]) -> object:
    """Run in a thread of its own, with which its settings end."""
    result: list[object] = []
    thread = threading.Thread(target=lambda: result.append(body()))
    thread.start()
    thread.join()
    return result[0]


def test_the_timer_slack_is_the_requested_one() -> None:
    def slack_ns() -> int:
        assert realtime.set_timer_slack(2_000)
        return int(ctypes.CDLL(None).prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0))

    assert run_in_a_thread(slack_ns) == 2_000


def test_a_refused_priority_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert run_in_a_thread(realtime.use_realtime_priority) is False


@pytest.mark.parametrize(("state", "is_set"), [(0, True), (1, True), (5, False), (-1, False)])
def test_a_clock_is_set_unless_the_kernel_reports_an_error(
    monkeypatch: pytest.MonkeyPatch, state: int, is_set: bool
) -> None:
    class Libc:
        @staticmethod
        def adjtimex(buffer: object) -> int:
            return state

    monkeypatch.setattr(realtime, "_libc", Libc)
    assert realtime.is_clock_set() is is_set


@pytest.mark.process
def test_the_garbage_collector_skips_loaded_objects_and_collects_later_ones() -> None:
    code = """
import gc, weakref
from devices.realtime import freeze_garbage_collector

class Ring:
    def __init__(self):
        self.me = self

Ring()
freeze_garbage_collector()
assert not any(isinstance(each, Ring) for each in gc.get_objects())
loaded = gc.get_freeze_count()
assert loaded > 1000 and len(gc.get_objects()) < 100, (loaded, len(gc.get_objects()))
later = weakref.ref(Ring())
gc.collect()
assert later() is None
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60.0)


@pytest.mark.process
def test_a_process_ends_with_its_killed_parent() -> None:
    child = (
        "import sys, time; from devices.realtime import terminate_with_parent; "
        "terminate_with_parent(); print(1, flush=True); time.sleep(60)"
    )
    parent = (
        "import subprocess, sys, time; "
        f"p = subprocess.Popen([sys.executable, '-c', {child!r}], stdout=subprocess.PIPE); "
        "p.stdout.readline(); print(p.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        with os.fdopen(os.pidfd_open(pid)) as child_end:
            process.send_signal(signal.SIGKILL)
            ended, _, _ = select.select([child_end], [], [], 10.0)
    assert ended
