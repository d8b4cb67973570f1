"""What a node says of its streams when it greets a server."""

from __future__ import annotations

from pathlib import Path

from service.node.connection import hello_of
from service.node.options import NodeOptions
from service.rig.rig import RigOptions
from storage.journal.node_journal import NodeJournal
from tests.builders.arrays import make_array
from tests.builders.scenes import make_scene


def test_a_stream_that_begins_while_a_node_greets_is_not_said_to_have_ended(tmp_path: Path) -> None:
    journal = NodeJournal(tmp_path, "leg")
    before, present, newer = (journal.begin(make_array(boot_id=name * 32)) for name in "abc")
    options = NodeOptions(rig=RigOptions(make_scene(), "leg"), journal=tmp_path, server=None)
    hello = hello_of(options, journal, present)
    journal.close()
    assert not newer.has_ended
    assert [each.array_info.boot_id for each in hello.earlier] == [before.boot_id]
    assert not hello.has_more
