"""Check of a file's frames: numbers and order of each part.

`seq` and `t_mono_ns` rise within a part, and `t_ns` is `t_mono_ns` plus one offset. Every filter
over time relies on that; a file of another program, or an edited one, need not keep to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.frame_rules import mask_impossible_times
from storage.intervals import Intervals
from storage.schema import Array

_MAX_MESSAGES = 3


@dataclass
class PartFrameSummary:
    """Frames of one part: range, count, and disorder.

    Attributes:
        part: its number, from 0.
        seq_first: number of its first frame.
        seq_last: number of its last frame.
        frames: number of frames.
        offset_ns: `t_ns - t_mono_ns` of its first frame.
        t_mono_ns_first: instant of its first frame.
        t_mono_ns_last: instant of its last frame.
        numbers: frame numbers present.
        disorder_messages: messages about their order; the first few.
        disorder_count: how many there would be.
    """

    part: int
    seq_first: int
    seq_last: int
    offset_ns: int
    t_mono_ns_first: int
    t_mono_ns_last: int
    frames: int = 0
    numbers: Intervals = field(default_factory=Intervals)
    disorder_messages: list[str] = field(default_factory=list)
    disorder_count: int = 0

    @property
    def gaps(self) -> Intervals:
        """Numbers between the first and the last without a frame."""
        first, last = sorted((self.seq_first, self.seq_last))
        return self.numbers.missing_in(first, last)


class FrameOrderChecker:
    """Check of frame order, piece by piece; results are in `parts` and `disorder_messages`."""

    def __init__(self) -> None:
        self.parts: list[PartFrameSummary] = []
        self.disorder_messages: list[str] = []
        """Messages about the order of the parts."""

    @property
    def problems(self) -> list[str]:
        """Messages about all disorder."""
        found = list(self.disorder_messages)
        for part in self.parts:
            found += [f"part {part.part}: {message}" for message in part.disorder_messages]
            if part.disorder_count > len(part.disorder_messages):
                more = part.disorder_count - len(part.disorder_messages)
                found.append(f"part {part.part}: and {more} more of the kind")
        return found

    def add_and_check_frames(self, columns: Mapping[str, Array]) -> None:
        """Add the next frames, and collect messages about their order; nothing is raised.

        Args:
            columns: `seq`, `t_mono_ns`, `t_ns` and, if the file has it, `part`; n rows each.
        """
        rows = len(columns["seq"])
        numbers = columns.get("part", np.zeros(rows, dtype=np.uint16))
        if not rows:
            return
        cuts = [0, *(np.flatnonzero(numbers[1:] != numbers[:-1]) + 1).tolist(), rows]
        for begin, end in pairwise(cuts):
            cut = {name: columns[name][begin:end] for name in ("seq", "t_mono_ns", "t_ns")}
            self._check_part_frames(int(numbers[begin]), cut["seq"], cut["t_mono_ns"], cut["t_ns"])

    def _check_part_frames(self, number: int, seq: Array, t_mono_ns: Array, t_ns: Array) -> None:
        if not self.parts or self.parts[-1].part != number:
            if self.parts and number < self.parts[-1].part:
                self.disorder_messages.append(f"part {number} follows part {self.parts[-1].part}")
            self.parts.append(
                PartFrameSummary(
                    part=number,
                    seq_first=int(seq[0]),
                    seq_last=int(seq[0]),
                    offset_ns=int(t_ns[0]) - int(t_mono_ns[0]),
                    t_mono_ns_first=int(t_mono_ns[0]),
                    t_mono_ns_last=int(t_mono_ns[0]),
                )
            )
        part = self.parts[-1]
        if part.frames:
            seq = np.concatenate([np.array([part.seq_last], seq.dtype), seq])
            before = np.array([part.t_mono_ns_last], t_mono_ns.dtype)
            with_before = np.concatenate([before, t_mono_ns])
        else:
            with_before = t_mono_ns
        falls = seq[1:] <= seq[:-1]
        back = with_before[1:] < with_before[:-1]
        for at in np.flatnonzero(falls).tolist():
            _add_message(part, f"frame {seq[at + 1]} follows frame {seq[at]}")
        for at in np.flatnonzero(back & ~falls).tolist():
            late_ns = int(with_before[at]) - int(with_before[at + 1])
            _add_message(part, f"time runs back by {late_ns} ns before frame {seq[at + 1]}")
        beyond = mask_impossible_times(t_mono_ns, t_ns)
        shifted = (t_ns - t_mono_ns != part.offset_ns) & ~beyond  # beyond, a difference may wrap
        for wrong, problem in (
            (beyond, "is in no possible year"),
            (shifted, "is not t_mono_ns plus the part's offset"),
        ):
            if wrong.any():
                first = int(seq[len(seq) - len(t_ns) + int(np.argmax(wrong))])
                _add_message(part, f"t_ns of frame {first} {problem}")
        breaks = np.flatnonzero((seq[1:] - seq[:-1] != 1) | falls) + 1
        cuts = [0, *breaks.tolist(), len(seq)]
        for begin, end in pairwise(cuts):
            part.numbers.add(int(seq[begin]), int(seq[end - 1]))
        part.frames += len(t_ns)
        part.seq_last, part.t_mono_ns_last = int(seq[-1]), int(t_mono_ns[-1])


def iterate_checking_order(
    pieces: Iterable[tuple[FrameBatch, Mapping[str, Array]]], *, where: str
) -> Iterator[tuple[FrameBatch, Mapping[str, Array]]]:
    """Yield the same frames, for readers that rely on their order.

    Raises:
        FileFormatError: the first frame out of order is reached.
    """
    order = FrameOrderChecker()
    for frames, extra in pieces:
        columns = {"seq": frames.seq, "t_mono_ns": frames.t_mono_ns, "t_ns": frames.t_ns}
        order.add_and_check_frames(
            columns | {name: extra[name] for name in ("part",) if name in extra}
        )
        if problems := order.problems:
            raise FileFormatError(
                f"its frames are out of order: {problems[0]}",
                where=where,
                expected="seq and t_mono_ns rising within a part, t_ns at one offset from it",
                remedy="`foottile verify` lists what else is wrong",
            )
        yield frames, extra


def _add_message(part: PartFrameSummary, text: str) -> None:
    part.disorder_count += 1
    if len(part.disorder_messages) < _MAX_MESSAGES:
        part.disorder_messages.append(text)
