"""What a session is called never controls a terminal, and never forges a line of a report.

Files may come from anywhere, so names in them are hostile whatever the server refuses today.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.cli.commands import find
from service.cli.main import SUMMARIES
from storage.sessions.folder import Marker
from tests.builders.arrays import UTC_NS
from tests.service.cli.outcome import Run
from tests.service.sessions.crashed import ID, info_of, session, stream

FORGED = "FORGED: everything is whole"
HOSTILE = (
    f"walk\n{FORGED}\r\n{FORGED}\x1b[2J\x1b]0;title\x07\x9b31m\u202egnp\u200b\ufeff\u2028{FORGED}"
)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder whose session has a hostile text wherever a text can be."""
    root = tmp_path / "data"
    stream(root, info_of(), (0, 99), next_seq=100)
    session(
        root,
        name=HOSTILE,
        subject=HOSTILE,
        notes=HOSTILE,
        tags=(HOSTILE,),
        markers=(Marker(id="0" * 12, label=HOSTILE, t_ns=UTC_NS),),
        take="20200101T000000Z-00000b",
        problem=HOSTILE,
    )
    return root


COMMANDS: dict[str, tuple[tuple[object, ...], ...]] = {
    "accept-node": ((HOSTILE, "--server", "http://127.0.0.1:1"),),
    "calibrate": ((ID, "--out", "cal.json"),),
    "compare": ((ID, "--reference", "gone.csv", "--out", "o"),),
    "estimate": ((ID, "--out", "x.parquet"),),
    "export": (
        (ID, "--format", "csv", "--out", "x.csv"),
        (ID, "--format", "csv", "--out", f"gone{HOSTILE}/x.csv"),
    ),
    "node": (("--record", HOSTILE), ("--scene", HOSTILE), ("--name", HOSTILE)),
    "query": (
        ("SELECT name, tags FROM sessions",),
        (f"SELECT '{HOSTILE}' AS \"{HOSTILE}\"",),
        (HOSTILE,),
    ),
    "recover": ((),),
    "sessions": ((), ("--node", HOSTILE), ("--from", HOSTILE)),
    "video": (
        ("list", ID),
        ("add", ID, f"{HOSTILE}.mp4"),
        ("list", HOSTILE),
        (HOSTILE, ID),
        ("align", ID, HOSTILE, "--by", "light"),
        ("align", ID, "0" * 12, "--by", HOSTILE),
        ("track", ID, HOSTILE, "--dots", HOSTILE),
    ),
    "verify": ((ID,), (), (HOSTILE,), ("--manifest", HOSTILE)),
    # What these print of names is the user's own, or a scene's, which has to be one of a few words.
    "benchmark": (("--scene", HOSTILE, "--out", "o"),),
    "demo": (("--scene", HOSTILE),),
    "doctor": (("--scene", HOSTILE),),
    "domes": (("--family", HOSTILE),),
    "bridge": ((HOSTILE,), ("mqtt", HOSTILE, "--server", "http://127.0.0.1:1")),
    "find": ((),),
    "pull": ((HOSTILE, "--out", "o", "--server", "http://127.0.0.1:1"),),
    "reproduce": (("--out", "/dev/null/x" + HOSTILE),),
    "serve": (("--host", HOSTILE),),
    "simulate": (("--scene", HOSTILE, "--out", "x.parquet"),),
    "stream": ((HOSTILE, "--server", "http://127.0.0.1:1"),),
    "invite": (("--server", HOSTILE),),
}
_IN_FOLDER = {
    *("calibrate", "compare", "estimate", "export", "query", "sessions", "verify", "video"),
}


def test_every_command_is_tried() -> None:
    assert set(COMMANDS) == set(SUMMARIES)


@pytest.mark.parametrize("is_sealed", [False, True])
@pytest.mark.parametrize("command", COMMANDS)
def test_no_name_controls_a_terminal_or_makes_a_line(
    run: Run, data: Path, command: str, is_sealed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(find, "_SEARCH_S", 0.05)
    if is_sealed:
        run("recover", data)
    for arguments in COMMANDS[command]:
        where: tuple[object, ...] = ("--data", data) if command in _IN_FOLDER else ()
        if command == "recover":
            where = (data,)
        outcome = run(command, *arguments, *where)
        for text in (outcome.out, outcome.err):
            lines = text.split("\n")
            assert [line for line in lines if not line.isprintable()] == []
            assert [line for line in lines if line.lstrip(" │|").startswith("FORGED")] == []


def test_json_keeps_the_name_as_it_is(run: Run, data: Path) -> None:
    recovered = run("recover", data, "--json")
    assert recovered.out.isascii()
    assert json.loads(recovered.out)["sessions"][0]["name"] == HOSTILE
