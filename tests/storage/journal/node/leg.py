"""What a node takes, and what it has and gives."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from tests.storage.stream import message
from tests.waiting import until

Start = Callable[..., NodeJournal]


def fill(journal: NodeJournal, stream: NodeStream, first: int, last: int) -> None:
    """Take frames `first` to `last`, ten in a batch."""
    for begin in range(first, last + 1, 10):
        journal.queue_batch_and_limit_memory(stream, message(begin, min(begin + 9, last)))


def store(journal: NodeJournal, stream: NodeStream, first: int, last: int) -> None:
    """Take frames, and wait until they are on the disk."""
    fill(journal, stream, first, last)
    until(lambda: stream.stored.last == last)


def given(stream: NodeStream, first: int, last: int) -> list[int]:
    """First numbers of the batches that it gives for these frames."""
    return [batch.seq_first for batch in stream.read_overlapping_batches(first, last)]


def killed(journal: NodeJournal, folder: Path) -> Path:
    """The node's folder as SIGKILL leaves it: what the kernel has."""
    copy = folder.with_name(folder.name + "-killed")
    shutil.copytree(folder, copy)
    journal.end_streams_and_close()
    return copy
