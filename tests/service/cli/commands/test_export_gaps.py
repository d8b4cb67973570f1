"""`foottile export` and `pull` to a format without unknown values, of a session with gaps."""

from __future__ import annotations

import re
from pathlib import Path

from tests.builders.arrays import PERIOD_NS
from tests.service.cli.outcome import Run
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording


def stand(node: FakeNode, *missing: int) -> Recording:
    """A session of a foot that stands, with so many slots without a frame in it."""
    session = node.record()
    for slots in missing:
        node.send(250, [30.0, 65.0], alive=True)
        node.next_t_mono_ns += slots * PERIOD_NS
    node.deliver(250, [30.0, 65.0], alive=True)
    node.finish(session)
    return session


def test_short_gaps_are_said_to_be_filled(tared: FakeNode, run: Run, tmp_path: Path) -> None:
    session = stand(tared, 14)
    told = "1 gaps of the force are straight lines, the longest 30.0 ms"
    wanted = ("--format", "opensim", "--out")
    done = run("export", session.id, *wanted, "x.zip", "--data", str(session.running.data))
    done.succeeds()
    assert told in done.err
    pulled = run("pull", session.id, *wanted, "here", "--server", session.running.url)
    pulled.succeeds()
    assert told in pulled.err
    path = f"{session.url}/data"
    answer = session.running.http.get(path, params={"format": "opensim"})
    assert told in answer.headers["foottile-remarks"]
    assert "foottile-remarks" not in session.running.http.get(path).headers


def test_a_long_gap_is_refused_unless_it_may_end_the_file(
    tared: FakeNode, run: Run, tmp_path: Path
) -> None:
    session = stand(tared, 100)
    data, server = ("--data", str(session.running.data)), ("--server", session.running.url)
    wanted = ("--format", "opensim", "--out")
    slices = set()
    for command, out, source in (("export", "x.zip", data), ("pull", "here", server)):
        refused = run(command, session.id, *wanted, out, *source)
        assert refused.code in (1, 2)
        assert "a gap of the force is too long for a line, the longest 0.202 s" in refused.err
        assert "--long-gap end" in refused.err
        slices |= set(re.findall(r"from ([0-9.]+) s to ([0-9.]+) s", refused.err))
        ended = run(command, session.id, *wanted, out, *source, "--long-gap", "end")
        ended.succeeds()
        assert re.search(r"the file ends at 0\.\d+ s, before a gap of 0\.202 s", ended.err)
        wrong = run(command, session.id, *wanted, out, *source, "--long-gap", "fill")
        assert (wrong.code, "--long-gap 'fill'" in wrong.err) == (2, True)
    ((start_s, end_s),) = slices
    part = ("--start-s", start_s, "--end-s", end_s)
    run("export", session.id, *wanted, "y.zip", *data, *part).succeeds()
