"""A stepped wall clock, as a process sees it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.faults.clock_step import HOUR_NS, WallClock

Run = Callable[..., Any]

ASK = """
import datetime, json, time
print(json.dumps([
    time.time_ns(),
    time.time() * 1e9,
    time.clock_gettime_ns(time.CLOCK_REALTIME),
    time.clock_gettime(time.CLOCK_REALTIME) * 1e9,
    datetime.datetime.now(datetime.UTC).timestamp() * 1e9,
    datetime.datetime.now(tz=datetime.UTC).timestamp() * 1e9,
    datetime.datetime.now().timestamp() * 1e9,
    datetime.datetime.today().timestamp() * 1e9,
    datetime.datetime.utcnow().replace(tzinfo=datetime.UTC).timestamp() * 1e9,
]))
"""
STEADY = "import time; print(time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME))"


def test_every_reading_of_the_wall_clock_is_stepped(run: Run, tmp_path: Path) -> None:
    clock = WallClock(tmp_path / "clock")
    for offset_ns in (0, HOUR_NS, -HOUR_NS):
        clock.step_to(offset_ns)
        before_ns, *_ = json.loads(run(ASK).out)
        readings = json.loads(run(ASK, **clock.environment()).out)
        after_ns, *_ = json.loads(run(ASK).out)
        slack_ns = 1e6  # datetime counts microseconds, and floats of ns are coarser
        for reading in readings:
            assert before_ns + offset_ns - slack_ns <= reading <= after_ns + offset_ns + slack_ns


def test_a_step_is_seen_while_the_process_runs_and_the_steady_clocks_do_not_move(
    run: Run, tmp_path: Path
) -> None:
    clock = WallClock(tmp_path / "clock")
    code = f"""
import time
from pathlib import Path
begin, steady = time.time_ns(), time.monotonic_ns()
Path({str(tmp_path / "clock")!r}).write_text({str(HOUR_NS)!r})
time.sleep(0.05)
print((time.time_ns() - begin) - (time.monotonic_ns() - steady))
"""
    assert abs(int(run(code, **clock.environment()).out) - HOUR_NS) < 1_000_000_000
    assert (
        int(run(STEADY).out.split()[0])
        < int(run(STEADY, **clock.environment()).out.split()[0])
        < int(run(STEADY).out.split()[0])
    )


def test_a_stepped_datetime_is_still_the_real_type(run: Run, tmp_path: Path) -> None:
    clock = WallClock(tmp_path / "clock")
    code = """
import datetime, pickle
from pydantic import TypeAdapter
now = datetime.datetime.now(datetime.UTC)
assert type(now) is datetime.datetime and isinstance(now, datetime.date)
assert pickle.loads(pickle.dumps(now)) == now
assert TypeAdapter(datetime.datetime).validate_python(now) == now
print(now.tzinfo)
"""
    assert run(code, **clock.environment()).out == "UTC\n"
