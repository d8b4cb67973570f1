"""A node on its own, of which a file is not what was written."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from devices.acquisition import AcquiredFrame
from devices.errors import FootTileError
from devices.frames import FrameBatch
from storage.intervals import Intervals, OpenPairs
from storage.journal.node.in_flight import InFlightWriter
from storage.journal.node.journal import NodeJournal
from storage.journal.node.retention import RetentionRequest
from storage.journal.node.stream import NodeStream
from storage.wire import encode_as_messages
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.damages import damaged_copies
from tests.hostile.data_folders import digest
from tests.waiting import until

BOOTS = ("a" * 32, "b" * 32)
_NODE_SAYS = ("retention.json", "stream.json")


def node_folder(folder: Path) -> Path:
    """The state of a node that was killed: a stream that ended, one in flight, what is wanted."""
    live = folder.with_name(f"{folder.name}-live")
    journal = NodeJournal(live, "leg")
    journal.start_writer()
    wants: dict[str, OpenPairs] = {BOOTS[0]: ((0, 49),), BOOTS[1]: ((100, None),)}
    journal.update_retention_request(
        "laptop", RetentionRequest(streams=wants, recording=True, known=BOOTS)
    )
    for stream_id in BOOTS:
        info = make_array(node="leg", stream_id=stream_id)
        stream = journal.switch_to_new_stream(info)
        in_flight = InFlightWriter(stream.folder, info)
        for first in range(0, 200, 10):
            frames = make_frames(np.arange(first, first + 10))
            for row in rows_of(frames):
                in_flight.write_frame(row)
            for message in encode_as_messages(frames, info):
                journal.queue_batch_and_limit_memory(stream, message)
        in_flight.close()
        until(partial(_is_stored, stream))
    until((live / "journal" / "leg" / "retention.json").exists)
    until(lambda: not (live / "journal" / "leg" / BOOTS[0] / "in_flight").exists())
    shutil.copytree(live, folder)  # as SIGKILL leaves it
    journal.end_streams_and_close()
    return folder


@attack(
    "every file of a node's folder, damaged in every way",
    tries=30,
    soak_tries=2_000,
    is_alone=False,
)
def folder_of_a_node(play: Play) -> Outcome:
    """One file of a node's state is damaged, then its journal is opened, goes on and is tidied.

    Failures: it does not open; a frame is other than it was; a frame of a stream that is not
    damaged is gone; what says what is wanted, or of a stream, is damaged and no problem names it; a
    new stream is not kept.
    """
    outcome = Outcome()
    data = node_folder(play.folder / "node")
    for copy, path, what, is_same in damaged_copies(data, play):
        try:
            wrong, said = _goes_on(copy, [boot for boot in BOOTS if boot not in path.parts])
        except FootTileError as error:
            outcome.failed(f"{what}: {error}")
            continue
        is_named = any(path.name in text for text in said)
        if wrong:
            outcome.failed(f"{what}: {wrong}")
        elif path.name in _NODE_SAYS and not is_same and not is_named:
            outcome.failed(f"{what}: nothing is said of it: {said}")
        else:
            outcome.saw("said by name, and it goes on" if is_named else "it goes on")
    return outcome


def _goes_on(root: Path, undamaged: Sequence[str]) -> tuple[str, list[str]]:
    """What is wrong with a node's journal that is opened now, and what it says."""
    journal = NodeJournal(root, "leg")
    journal.start_writer()
    try:
        info = make_array(node="leg", stream_id="c" * 32)
        stream = journal.switch_to_new_stream(info)
        for message in encode_as_messages(make_frames(np.arange(10)), info):
            journal.queue_batch_and_limit_memory(stream, message)
        until(lambda: stream.stored.last == 9)
        known = {each.stream_id: each for each in journal.streams}
        for stream_id in undamaged:
            if stream_id not in known or known[stream_id].available != Intervals([(0, 199)]):
                return f"stream {stream_id} is not whole", journal.problems
        for each in known.values():
            read = 0
            try:
                for batch in each.journal.read_frames(0, 199) if each.journal else ():
                    taken = make_frames(batch.seq.astype(np.int64))
                    if digest(batch) != digest(taken):
                        return "other frames", journal.problems
                    read += len(batch)
            except FootTileError as error:
                if each.stream_id in undamaged:
                    return f"stream {each.stream_id}: {error}", journal.problems
            if each.stream_id in undamaged and read != 200:
                return f"of stream {each.stream_id} only {read} are read", journal.problems
        return "", list(journal.problems)
    finally:
        journal.end_streams_and_close()


def _is_stored(stream: NodeStream) -> bool:
    return stream.stored.last == 199 and stream.is_synced


def rows_of(frames: FrameBatch) -> list[AcquiredFrame]:
    """Frames one by one, as acquisition has them."""
    return [
        AcquiredFrame(*(getattr(frames, name)[i].tolist() for name in AcquiredFrame._fields))
        for i in range(len(frames))
    ]
