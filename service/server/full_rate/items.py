"""Events of the live feed: frames, gaps, stream starts."""

from __future__ import annotations

from dataclasses import dataclass

from service.server.estimates.of_node import Estimated


@dataclass(frozen=True)
class Position:
    """Next frame of a reader."""

    boot_id: str
    seq: int

    def __str__(self) -> str:
        """Return the query to resume from here, as text that programs parse."""
        return f"resume with boot_id={self.boot_id}&from_seq={self.seq}"


@dataclass(frozen=True)
class Rows:
    """Consecutive frames of one stream with their estimates, if any."""

    boot_id: str
    estimated: Estimated
    number: int | None = None
    """Number of the buffered batch, if these are all of its rows."""
    recomputed: bool = False

    @property
    def from_seq(self) -> int:
        """Number of the first frame."""
        return int(self.estimated[0].seq[0])

    @property
    def to_seq(self) -> int:
        """Number of the last frame."""
        return int(self.estimated[0].seq[-1])


@dataclass(frozen=True)
class Missing:
    """Frames that are left out, both ends included."""

    boot_id: str
    from_seq: int
    to_seq: int
    reason: str
    """`slow`: the reader was too slow; `late`: the frames did not come in time. Else the loss
    reason."""


@dataclass(frozen=True)
class Begins:
    """Start of a stream: the next events are of this stream."""

    boot_id: str
    from_seq: int


Item = Rows | Missing | Begins


def cut(estimated: Estimated, begin: int, end: int) -> Estimated:
    """Return rows `begin` to `end` - 1 of frames and their estimates; unchanged if that is all."""
    frames, columns = estimated
    if begin <= 0 and end >= len(frames):
        return estimated
    return frames.rows(begin, end), {name: v[begin:end] for name, v in columns.items()}
