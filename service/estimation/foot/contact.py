"""Contact: does the foot bear load? Thresholds with hysteresis, and a minimum time.

A change is believed if it lasts `min_ns`, and is then dated back to its beginning as far as the
look-ahead allows: with a lag of at least `min_ns` contact begins with the first loaded frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Ints, Times
from devices.compiled import compiled, inlined
from service.estimation.records import Record, record_type

UNKNOWN = 255
UNSEEN_NS = 50_000_000
"""A foot not seen for longer than this may have been lifted and put down again."""


@dataclass(frozen=True)
class ContactRule:
    """When the foot is in contact.

    Attributes:
        on_n: force above which it seems to be.
        off_n: force below which it seems not to be; in between it stays what it was.
        min_ns: how long it has to seem so.
    """

    on_n: float
    off_n: float
    min_ns: int


STATE = record_type([("loaded", np.int64), ("since_ns", np.int64)])
"""Does the foot seem loaded, and since when has it seemed so? Zeros before the first frame."""


@compiled
def seeming(
    on_n: float, off_n: float, state: Record, grf_n: float, t_ns: int, broken: bool
) -> None:
    """Whether the foot seems loaded in the next frame, and since when it has seemed so.

    Args:
        on_n: of `ContactRule`.
        off_n: likewise.
        state: from the frame before; becomes that after this one.
        grf_n: NaN changes nothing.
        t_ns: instant.
        broken: is the frame broken from the one before, by a gap? Then a new run begins.
    """
    loaded = 1 if grf_n >= on_n else (0 if grf_n <= off_n else state.loaded)
    if loaded != state.loaded or broken:
        state.since_ns = t_ns
    state.loaded = loaded


@inlined
def has_lasted(since_ns: Times, t_ns: Times, i: int, end: int, min_ns: int, lag_ns: int) -> bool:
    """Has what the foot seems to be in frame `i` lasted long enough, as far as can be seen?

    Args:
        since_ns: (n,), per frame since when it has seemed so; `seeming` tells.
        t_ns: (n,), instants.
        i: frame.
        end: frame after the last that is there; those within the look-ahead must all be.
        min_ns: of `ContactRule`.
        lag_ns: look-ahead.
    """
    at = i
    while at < end and since_ns[at] == since_ns[i] and t_ns[at] <= t_ns[i] + lag_ns:
        if t_ns[at] - since_ns[i] >= min_ns:
            return True
        at += 1
    return False


@dataclass(frozen=True)
class Stance:
    """One contact of the foot with the ground.

    Attributes:
        begin_t_ns: UTC of its first frame.
        end_t_ns: UTC of its last.
        peak_n: greatest GRF; NaN if none is known, or a tile was saturated.
        peak_t_ns: when that was; of such a stance when it began.
        impulse_ns: integral of the GRF by the trapezoidal rule, in newton seconds; straight across
            frames without one. NaN if a tile was saturated.
        unknown_frames: how many those are.
        begun: it began within the recording.
        ended: it ended within the recording.
    """

    begin_t_ns: int
    end_t_ns: int
    peak_n: float
    peak_t_ns: int
    impulse_ns: float
    unknown_frames: int
    begun: bool
    ended: bool

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return (self.end_t_ns - self.begin_t_ns) * 1e-9


class Stances:
    """Gathers stances from consecutive estimates; keeps the frames of the present one only."""

    def __init__(self) -> None:
        self._over: list[Stance] = []
        self._pieces: list[tuple[Ints, Floats]] = []
        self._saturated = False
        self._contact = 0
        self._begun = False
        self._seen = False

    def feed(
        self, t_ns: Times, grf_n: Floats, contact: npt.NDArray[np.uint8], saturated: Bools
    ) -> None:
        """Take n more frames.

        Args:
            t_ns: (n,), UTC.
            grf_n: (n,), NaN where it is not known.
            contact: (n,), 1, 0, or `UNKNOWN`, which changes nothing.
            saturated: (n,), frames in which more than can be told is borne.
        """
        known = contact != UNKNOWN
        last = np.maximum.accumulate(np.where(known, np.arange(len(contact)), -1))
        loaded = np.where(last >= 0, contact[last], self._contact)
        edges = np.flatnonzero(np.diff(loaded, prepend=np.uint8(self._contact)))
        for begin, end in zip([0, *edges], [*edges, len(loaded)], strict=True):
            if begin == end:
                continue
            if loaded[begin]:
                if not self._pieces:
                    self._begun = self._seen or bool(known[:begin].any())
                self._pieces.append((t_ns[begin:end], grf_n[begin:end]))
                self._saturated = self._saturated or bool(saturated[begin:end].any())
            else:
                self._close(ended=True)
        if len(loaded):
            self._contact = int(loaded[-1])
            self._seen = self._seen or bool(known.any())

    def finish(self) -> tuple[Stance, ...]:
        """All stances, in order; the last one perhaps has not ended."""
        self._close(ended=False)
        return tuple(self._over)

    def _close(self, *, ended: bool) -> None:
        if not self._pieces:
            return
        t_ns, grf_n = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        self._pieces = []
        there = np.isfinite(grf_n)
        known_n, known_ns = grf_n[there], t_ns[there]
        # The peak was in what is not known, and no straight line is above it.
        peak = int(np.argmax(known_n)) if len(known_n) and not self._saturated else -1
        impulse_ns = float(np.trapezoid(known_n, (known_ns - t_ns[0]) * 1e-9))
        self._over.append(
            Stance(
                begin_t_ns=int(t_ns[0]),
                end_t_ns=int(t_ns[-1]),
                peak_n=float("nan") if peak < 0 else float(known_n[peak]),
                peak_t_ns=int(t_ns[0]) if peak < 0 else int(known_ns[peak]),
                impulse_ns=float("nan") if self._saturated else impulse_ns,
                unknown_frames=int((~there).sum()),
                begun=self._begun,
                ended=ended,
            )
        )
        self._saturated = False
