"""Stances: contacts of the foot with the ground, gathered from estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Ints, Times

UNKNOWN = 255
"""Contact in a frame in which it is not known."""


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
