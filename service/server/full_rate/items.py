"""What a reader of every frame is given, one after the other: frames, and what is left out."""

from __future__ import annotations

from dataclasses import dataclass

from service.server.estimates.of_node import Estimated


@dataclass(frozen=True)
class Position:
    """The frame of a stream that is wanted next."""

    boot_id: str
    seq: int

    def __str__(self) -> str:
        """How to go on from there, as text that programs read."""
        return f"resume with boot_id={self.boot_id}&from_seq={self.seq}"


@dataclass(frozen=True)
class Rows:
    """Frames with their estimates, which may be none; consecutive, of one stream."""

    boot_id: str
    estimated: Estimated
    number: int | None = None
    """Of the piece in memory, if it is all of it."""
    recomputed: bool = False

    @property
    def from_seq(self) -> int:
        """Number of the first of them."""
        return int(self.estimated[0].seq[0])

    @property
    def to_seq(self) -> int:
        """Number of the last of them."""
        return int(self.estimated[0].seq[-1])


@dataclass(frozen=True)
class Missing:
    """Frames that are left out, ends included."""

    boot_id: str
    from_seq: int
    to_seq: int
    reason: str
    """`slow`: this reader was; `late`: they were not here in time. Else why they are lost."""


@dataclass(frozen=True)
class Begins:
    """What follows is of this stream."""

    boot_id: str
    from_seq: int


Item = Rows | Missing | Begins


def cut(estimated: Estimated, begin: int, end: int) -> Estimated:
    """Rows `begin` to `end` - 1 of frames and their estimates; themselves, if that is all."""
    frames, columns = estimated
    if begin <= 0 and end >= len(frames):
        return estimated
    return frames.rows(begin, end), {name: v[begin:end] for name, v in columns.items()}
