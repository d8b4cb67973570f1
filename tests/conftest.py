"""Shared by all tests: a cache of the emulated rig, reproducible examples, tests in turn, hangs."""

from __future__ import annotations

import faulthandler
import gc
import hashlib
import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.tokens import SHARED_TOKEN

# Collection makes millions of objects and hardly any garbage: a third of its time was the search.
gc.disable()

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background jobs ignore SIGINT; processes of the tests must not inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)

TESTS = Path(__file__).parent
TURN = os.environ.get("FOOTTILE_TURN")
"""Number of the run, of which the part in turn follows; None: all tests are run."""
PARTS = 4
"""Number of parts of the slow tests; a run plays one part. The slowest have 8: `slow(parts=8)`."""

# Failed assertions of builders show their values, as those of tests do.
pytest.register_assert_rewrite("tests.builders")

# Other tests run on the same cores, so no example has a deadline. Examples are the same in each
# run, so that a failure is due to the change; the profile `chance` draws new ones.
settings.register_profile("chance", deadline=None)
settings.register_profile("foottile", deadline=None, derandomize=True)
settings.load_profile("foottile")


@pytest.fixture(scope="session", autouse=True)
def _user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give commands and clients the shared token, and keep records of servers out of the home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FOOTTILE_TOKEN", SHARED_TOKEN)
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def bench_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """User's cache folder of all tests: a calibration on the emulated rig takes seconds."""
    given = os.environ.get("FOOTTILE_TEST_CACHE")
    return Path(given) if given else tmp_path_factory.mktemp("cache")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="run what takes long, too")


def is_of_this_run(item: pytest.Item) -> bool:
    """Return whether this run plays a slow test. Without a turn it plays all.

    A run plays a quarter of the tests marked `slow`, an eighth of those marked `slow(parts=8)`, and
    a quarter of the files marked `in_turn`. Tests of the same parameters are played together: they
    share what is computed from these.
    """
    mark = item.get_closest_marker("slow")
    parts = mark.kwargs.get("parts", PARTS) if mark else PARTS
    name = item.name.partition("[")[2] or item.name
    if item.get_closest_marker("in_turn"):
        name, parts = item.path.name, PARTS
    # By this byte of the digest, runs take more equal times than by the others.
    return TURN is None or hashlib.sha256(name.encode()).digest()[7] % parts == int(TURN) % parts


@pytest.hookimpl(tryfirst=True)  # a worker's own loop ends the call
def pytest_runtestloop() -> None:
    gc.freeze()  # what collection made stays, and each search of everything took 0.4 s
    gc.enable()


STDERR = pytest.StashKey[int]()
"""The standard error of the whole run: that of a test is captured."""


def pytest_configure(config: pytest.Config) -> None:
    config.stash[STDERR] = os.dup(2)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None]:
    """Watch a test that failed, too: there pytest ends its own watch, and a fixture may hang."""
    watch_for_hang(item.config)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Watch the end of the process, which waits for threads that a test has left."""
    watch_for_hang(config)


def watch_for_hang(config: pytest.Config) -> None:
    """Print all stacks and end the process, whatever it waits for, unless that is cancelled."""
    seconds = float(config.getini("faulthandler_timeout"))
    faulthandler.dump_traceback_later(seconds, file=config.stash[STDERR], exit=True)


def pytest_report_header() -> str | None:
    return f"slow tests: those of turn {TURN}" if TURN is not None else None


@pytest.hookimpl(tryfirst=True)  # before -m chooses by these marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    plays_all = config.getoption("--soak")
    # First those of packages and extras: their processes take longest, and would end alone.
    items.sort(key=lambda item: item.path.parent != TESTS)
    for item in items:
        is_slow = item.get_closest_marker("slow") or item.get_closest_marker("in_turn")
        if is_slow and (plays_all or not is_of_this_run(item)):
            item.add_marker(pytest.mark.soak)
        if not plays_all and item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.skip(reason="takes long; run with --soak"))
