"""What the harness knows of a round by itself, for the checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from tests.faults.link_witness import Columns, Witness, columns_of, joined
from tests.faults.product import NODE
from tests.faults.stories import Story


@dataclass(frozen=True)
class End:
    """How a stream ended, and what it had then.

    Attributes:
        how: `killed`, or `power`: its machine lost power.
        last_seq: the last frame in the node's journal, in the page cache of the moment; None: no
            journal.
        at_s: when, by `time.monotonic`.
        slow_s: how long an fsync took then, beyond the usual.
        longest_wait_s: longest time that frames of the stream had waited for the disk, beyond the
            usual; the stated bound of its tail remembers that.
    """

    how: str
    last_seq: int | None
    at_s: float
    slow_s: float = 0.0
    longest_wait_s: float = 0.0


@dataclass
class Facts:
    """Everything there is to judge a round by."""

    story: Story
    witness: Witness
    sealed_root: Path
    """The data folder in which the session is sealed."""
    node_root: Path
    rate_hz: float
    """Of the node's frames."""
    started_s: float = 0.0
    """When the start of the session had been answered, by `time.monotonic`."""
    stopped_s: float = 0.0
    """When it was asked to stop."""
    stop_sigma_s: float | None = 0.0
    """How well the server knew the node's clock then; None: not at all, as just after a date was
    set. Then the session ends with the newest frame that had come."""
    ends: dict[str, End] = field(default_factory=dict)
    """Streams that were ended by a fault, by stream_id."""
    kept_by_node: dict[str, Columns] = field(default_factory=dict)
    """What was in the node's journal whenever it was looked at, by stream_id."""
    elsewhere: frozenset[str] = frozenset()
    """Streams that are parts of another session."""
    lossy_elsewhere: bool = False
    """Is another session in the same folder lossy?"""
    session: dict[str, Any] = field(default_factory=dict)
    """As the API gives it in the end."""
    ledger: dict[str, Any] = field(default_factory=dict)
    file: bytes | None = None
    """The sealed file as it was downloaded."""
    verify_code: int | None = None
    verify_said: str = ""

    def look_into_journal(self) -> dict[str, Columns]:
        """What the node's journal holds now, by stream_id; it is remembered, too."""
        found = journal_of(self.node_root)
        for stream_id, columns in found.items():
            before = self.kept_by_node.get(stream_id)
            pieces = [piece for piece in (before, columns) if piece is not None]
            both = joined(pieces)
            assert both is not None
            self.kept_by_node[stream_id] = both
        return found


def journal_of(root: Path, stream_id: str = "*") -> dict[str, Columns]:
    """All whole batches of a data folder's journal, by stream_id, read with plain Arrow."""
    found: dict[str, list[Columns]] = {}
    for path in sorted((root / "journal" / NODE).glob(f"{stream_id}/*.arrows")):
        pieces = found.setdefault(path.parent.name, [])
        try:
            with pa.OSFile(str(path), "rb") as file, pa.ipc.open_stream(file) as stream:
                for batch in stream:
                    pieces.append(columns_of(batch))
        except (pa.ArrowException, EOFError, OSError):
            continue  # its tail is not whole
    return {
        stream: columns
        for stream, pieces in found.items()
        if (columns := joined(pieces)) is not None
    }
