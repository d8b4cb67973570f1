"""`gpiod` on a chip of files, for processes that have this folder on their PYTHONPATH.

All names are the library's own but `request_lines`. A chip is a folder; an input line a FIFO in it
with records as `tests.devices.array.gpio_chip` writes them; an output line a file with 0
or 1, beside a log of all its levels with their times.
"""

# Names of the library, which is executed below, are known to no checker.
# ruff: noqa: F821
# mypy: ignore-errors

import importlib.machinery
import os
import select
import struct
import sys
import time
from pathlib import Path

_spec = importlib.machinery.PathFinder.find_spec(
    "gpiod", [p for p in sys.path if Path(p or ".").resolve() != Path(__file__).parents[1]]
)
__path__ = list(_spec.submodule_search_locations)
exec(compile(Path(_spec.origin).read_text(), _spec.origin, "exec"))  # noqa: S102  # the installed library

from gpiod.exception import RequestReleasedError  # noqa: E402  # __path__ is set above

RECORD = struct.Struct("<qIB")


class _Request:
    def __init__(self, chip, line, settings):
        self._settings = settings
        self._path = chip / f"line{line}"
        self._is_input = settings.direction is globals()["line"].Direction.INPUT
        self._is_released = False
        self._seqno = 0  # of 32 bits
        if self._is_input:
            # For writing, too: else it would be readable at its end without a writer.
            self._fd = os.open(self._path, os.O_RDWR | os.O_NONBLOCK)
        else:
            self.set_value(line, settings.output_value)

    def wait_edge_events(self, timeout=None):
        self._check_held()
        return bool(select.select([self._fd], [], [], timeout)[0]) and self._check()

    def read_edge_events(self, max_events=None):
        self._check_held()
        self._check()
        content = os.read(self._fd, (max_events or 1024) * RECORD.size)
        events = []
        for t_ns, lost, is_rising in RECORD.iter_unpack(content):
            wanted = self._settings.edge_detection.name
            if wanted not in ("BOTH", "RISING" if is_rising else "FALLING"):
                continue
            self._seqno = (self._seqno + 1 + lost) % 2**32
            kind = EdgeEvent.Type.RISING_EDGE if is_rising else EdgeEvent.Type.FALLING_EDGE
            events.append(EdgeEvent(kind.value, t_ns, 0, self._seqno, self._seqno))
        return events

    def set_value(self, line, value):
        self._check_held()
        t_ns, level = time.monotonic_ns(), int(value.value)
        with self._path.with_suffix(".log").open("a") as log:
            log.write(f"{t_ns} {level}\n")
        self._path.write_text(str(level))

    def release(self):
        self._is_released = True
        if self._is_input:
            os.close(self._fd)

    def _check_held(self):
        if self._is_released:
            raise RequestReleasedError

    def _check(self):
        os.stat(self._path)  # a line that was taken away raises ENOENT
        return True


def request_lines(path, *, consumer, config, event_buffer_size=None):
    ((line, settings),) = config.items()
    os.listdir(path)  # raises if the chip is not there or forbidden
    return _Request(Path(path), line, settings)
