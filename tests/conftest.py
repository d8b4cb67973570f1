"""What all tests share: one emulated bench, and hypothesis with neither stopwatch nor dice."""

from __future__ import annotations

import os
import signal
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.tokens import SHARED_TOKEN

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As of what a shell runs behind: processes of the tests would not hear Ctrl-C, either.
    signal.signal(signal.SIGINT, signal.default_int_handler)

TURN = os.environ.get("FOOTTILE_TURN")
"""A number that every run of continuous integration has to itself."""
PARTS = 4
"""Into so many parts, by file, go tests that are `in_turn`: a run plays one of them."""

# What a builder asserts is explained as in a test.
pytest.register_assert_rewrite("tests.builders")

# Beside other tests on the same cores the time that an example takes says nothing. A run tells of
# the change that it tests, so its examples are the same each time; chance has a run of its own.
settings.register_profile("chance", deadline=None)
settings.register_profile("foottile", deadline=None, derandomize=True)
settings.load_profile("foottile")


@pytest.fixture(scope="session", autouse=True)
def _user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Commands, and programs that use `foottile`, have the token that tests share, and leave no
    record of a server in the home of whoever runs the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FOOTTILE_TOKEN", SHARED_TOKEN)
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def bench_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's cache folder for all tests: to press a tile on the emulated bench takes seconds."""
    given = os.environ.get("FOOTTILE_TEST_CACHE")
    return Path(given) if given else tmp_path_factory.mktemp("cache")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="run what takes long, too")


def is_of_this_run(item: pytest.Item) -> bool:
    """Return whether this run plays a test marked `in_turn`. Without a turn it plays all."""
    return TURN is None or zlib.crc32(item.path.name.encode()) % PARTS == int(TURN) % PARTS


def pytest_report_header() -> str | None:
    return f"in turn: part {int(TURN) % PARTS} of 0 to {PARTS - 1}" if TURN is not None else None


@pytest.hookimpl(tryfirst=True)  # before -m chooses by these marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    plays_all = config.getoption("--soak")
    for item in items:
        if item.get_closest_marker("in_turn") and (plays_all or not is_of_this_run(item)):
            item.add_marker(pytest.mark.soak)
        if not plays_all and item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.skip(reason="takes long; run with --soak"))
