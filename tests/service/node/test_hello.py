"""What a node says of its streams when it greets a server."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.errors import CalibrationError
from service.node.running_node import NodeOptions, make_hello
from service.protocol.link import NodeStatus
from service.rig.emulated_foot import RigOptions
from storage.journal.node.journal import NodeJournal
from tests.builders.arrays import make_array
from tests.builders.scenes import make_scene
from tests.storage.journal.journals import filled


def test_a_stream_that_begins_while_a_node_greets_is_not_said_to_have_ended(tmp_path: Path) -> None:
    journal = NodeJournal(tmp_path, "leg")
    before, present, newer = (
        journal.switch_to_new_stream(make_array(stream_id=name * 32)) for name in "abc"
    )
    options = NodeOptions(
        rig_options=RigOptions(make_scene(), "leg"), node_folder=tmp_path, server_url=None
    )
    hello = make_hello(options, journal, present)
    journal.end_streams_and_close()
    assert not newer.has_ended
    assert [each.array_info.stream_id for each in hello.earlier] == [before.stream_id]
    assert not hello.has_more


@pytest.mark.parametrize("odd", ["\x1b[31mred", "\udcff", "two\nlines"])
def test_a_server_can_be_told_of_files_with_odd_names(tmp_path: Path, odd: str) -> None:
    journal = NodeJournal(tmp_path, "leg")
    stream = journal.switch_to_new_stream(make_array())
    journal.end_streams_and_close()
    filled(stream.folder, (0, 9)).close()
    (stream.folder / f"{odd}.arrows").mkdir()
    again = NodeJournal(tmp_path, "leg")
    why = str(CalibrationError("cannot be read", where=f"{odd}.toml"))
    options = NodeOptions(
        RigOptions(make_scene(), "leg"),
        node_folder=tmp_path,
        server_url=None,
        calibration_problem=why,
    )
    said = NodeStatus(missed_slots=0, warnings=tuple(again.problems))
    hello = make_hello(options, again, again.switch_to_new_stream(make_array(stream_id="b" * 32)))
    again.end_streams_and_close()
    assert "it is not a file" in " ".join(said.warnings)
    for message in (said, hello):
        assert type(message).model_validate_json(message.model_dump_json()) == message
