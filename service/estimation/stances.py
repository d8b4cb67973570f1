"""Stances: contacts of the foot with the ground, from estimates.

The only definition of a stance: a run of frames whose `contact` is 1, with the gaps in between that
are short against it (`_limit_gap_ns`). In a gap there is no frame (none was sampled, or it was
lost), or none with a known contact and GRF. During a longer one, or a restart of the node, the foot
may have been lifted: the stance is cut there, and another one begins.

In a short gap the force is interpolated linearly, and lies within the rhombus of all forces that
change no faster than elsewhere in the stance (docs/method.md). Half its area bounds the error of
the impulse, and its tip the peak.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Columns, Times
from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from service.estimation import LONG_GAP_NS
from service.estimation.stance_contact import (
    BRIDGED_GAP_MAX_NS,
    Contact,
    Frame,
    KnownFrames,
    UnknownFrames,
)

STANCE_INPUT_COLUMNS = (
    "contact",
    "grf_n",
    "grf_sigma_n",
    "cop_x_m",
    "cop_sigma_x_m",
    "estimate_flags",
)
"""Columns of estimates that stances need; with several parts also `part`."""

STANCE_COLUMNS = (
    *("number", "part", "begin_t_ns", "end_t_ns", "duration_s", "duration_sigma_s"),
    *("peak_grf_n", "peak_t_ns", "peak_sigma_n", "impulse_n_s", "impulse_sigma_n_s"),
    *("cop_x_first_m", "cop_x_last_m", "cop_x_range_m", "cop_x_range_sigma_m"),
    *("frames", "unknown_frames", "missing_frames", "gap_s", "estimate_flags"),
    *("begun", "ended", "is_whole"),
)
"""Columns of a table of stances."""

GAP_SHARE_MAX = 0.25
"""Greatest share of gaps in the duration of a whole stance, and of a gap beyond `LONG_GAP_NS`."""


@dataclass(frozen=True)
class Stance:
    """Contact of the foot with the ground. Unknown values are NaN.

    Attributes:
        number: number in its recording, from 1; cut stances count, too.
        part: part of the session.
        begin_t_ns: UTC of its first frame.
        end_t_ns: UTC of its last frame.
        duration_sigma_s: standard uncertainty of the duration (docs/method.md); NaN if it has not
            begun or ended, or if the GRF rises or falls too slowly there.
        peak_grf_n: largest GRF without the bias by noise (`service.estimation.stance_curves`); NaN
            without any, or if a tile was saturated, which hides the peak.
        peak_t_ns: UTC of the frame with that GRF; None without a peak.
        peak_sigma_n: standard uncertainty of the peak; NaN if a gap may hide a higher one: the peak
            is then a lower bound.
        impulse_n_s: integral of the GRF by the trapezoidal rule, in newton seconds; NaN if a tile
            was saturated, if the first or last frame has no GRF, or if gaps make up more than
            `GAP_SHARE_MAX` of the duration.
        impulse_sigma_n_s: standard uncertainty of the impulse, for errors of the GRF that are equal
            in all frames of the stance, and for the force in the gaps.
        cop_x_first_m: first known centre of pressure along x, in the foot frame.
        cop_x_last_m: last known one.
        cop_x_range_m: largest less smallest.
        cop_x_range_sigma_m: standard uncertainty of the range, with independent errors of smallest
            and largest; NaN if fewer than `COP_SHARE_MIN` of the frames have a COP, or if gaps make
            up more than `COP_GAP_SHARE_MAX` of the duration and `EDGE_NS`: the range is then a
            lower bound.
        frames: number of frames from the first to the last.
        unknown_frames: number of these without a GRF.
        missing_frames: number of missing frames between the first and the last.
        gap_s: total time of the gaps within it, and beside its first and last frame.
        estimate_flags: union of the flags of its frames.
        begun: the last known contact before it is none, and no gap in between is too long.
        ended: the next known contact after it likewise.
    """

    number: int
    part: int
    begin_t_ns: int
    end_t_ns: int
    duration_sigma_s: float
    peak_grf_n: float
    peak_t_ns: int | None
    peak_sigma_n: float
    impulse_n_s: float
    impulse_sigma_n_s: float
    cop_x_first_m: float
    cop_x_last_m: float
    cop_x_range_m: float
    cop_x_range_sigma_m: float
    frames: int
    unknown_frames: int
    missing_frames: int
    gap_s: float
    estimate_flags: int
    begun: bool
    ended: bool

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return (self.end_t_ns - self.begin_t_ns) * 1e-9

    @property
    def is_whole(self) -> bool:
        """True if both edges exist, and the impulse is known."""
        return self.begun and self.ended and bool(np.isfinite(self.impulse_n_s))

    def as_dict(self) -> dict[str, Any]:
        """Return the columns of `STANCE_COLUMNS` by name."""
        return {name: getattr(self, name) for name in STANCE_COLUMNS}


def compute_stances(seq: npt.NDArray[np.uint64], t_ns: Times, columns: Columns) -> list[Stance]:
    """Compute the stances of a complete recording; arguments as of `StanceDetector.add_frames`."""
    gathered = StanceDetector()
    return [*gathered.add_frames(seq, t_ns, columns), *gathered.finish()]


class StanceDetector:
    """Detector of stances in consecutive frames; the result does not depend on the batches.

    It stores sums and the last seconds: its memory does not grow with the length of a stance.
    """

    def __init__(self) -> None:
        self._seen: Frame | None = None
        self._open: Contact | None = None
        self._pieces: list[Contact] = []
        """Contacts before the open one, with gaps between that may be short against the stance."""
        self._unsure = UnknownFrames()
        self._number = 0

    def add_frames(
        self, seq: npt.NDArray[np.uint64], t_ns: Times, columns: Columns
    ) -> list[Stance]:
        """Add the next n frames; return the stances that have ended.

        Args:
            seq: (n,), numbers of the frames.
            t_ns: (n,), UTC.
            columns: `STANCE_INPUT_COLUMNS`, (n,) each, contact being 1, 0 or `CONTACT_UNKNOWN`;
                `part`, 0 if absent.
        """
        over: list[Stance] = []
        sure = np.flatnonzero(columns["contact"] != CONTACT_UNKNOWN)
        if not len(sure):
            self._unsure.add_frames(columns["estimate_flags"])
            return over
        known: npt.NDArray[Any] | slice = sure
        if len(sure) == len(columns["contact"]):
            known = slice(None)  # as nearly always, and nothing is copied
        part = columns["part"][known] if "part" in columns else np.zeros(len(sure), np.uint16)
        loaded = columns["contact"][known] == 1
        is_after_gap = (columns["estimate_flags"][known] & EstimateFlag.GAP) != 0
        grf_n = columns["grf_n"][known]
        frames = KnownFrames(seq[known], t_ns[known], part, loaded, grf_n, is_after_gap)
        for first, end in frames.iterate_runs():
            begin, last = frames.get_frame(first), frames.get_frame(end - 1)
            if first or not begin.continues(self._seen):
                over += self._end_contact(begin)
            if begin.loaded:
                since = int(sure[first])
                if self._open is None:
                    skipped = slice(int(sure[first - 1]) + 1 if first else 0, since)
                    self._unsure.add_frames(columns["estimate_flags"][skipped])
                    before = self._seen if begin.is_edge(self._seen) else None
                    self._open = Contact(begin, before)
                else:
                    since = 0
                self._open.add_unknown_frames(self._unsure)
                self._open.add_frames(slice(since, int(sure[end - 1]) + 1), seq, t_ns, columns)
                self._open.last = last
            self._seen, self._unsure = last, UnknownFrames()
        self._unsure.add_frames(columns["estimate_flags"][int(sure[-1]) + 1 :])
        return over

    def finish(self) -> list[Stance]:
        """Return the stance that has not ended, if there is one, at the end of the frames."""
        return self._end_contact(None)

    def _end_contact(self, behind: Frame | None) -> list[Stance]:
        """Return the stances that are over once `behind`, the next known frame, is there."""
        contact, self._open = self._open, None
        if contact is None:
            return []
        self._pieces.append(contact)
        if contact.last.may_be_bridged_to(behind):
            if _measure_ns(self._pieces) * GAP_SHARE_MAX >= BRIDGED_GAP_MAX_NS:
                self._pieces = [_join_contacts(self._pieces)]  # no gap cuts it any more
            return []
        over = []
        for pieces in _split_at_long_gaps(self._pieces):
            self._number += 1
            joined = _join_contacts(pieces)
            after = behind if joined.last.is_edge(behind) else None
            over.append(_make_stance(joined, self._number, after))
        self._pieces = []
        return over


def _limit_gap_ns(duration_ns: int) -> int:
    """Return the greatest gap that is short against a stance of a duration.

    In `LONG_GAP_NS` no foot is lifted and put down again. A swing lasts a quarter of a stance only
    if the foot is down for four fifths of the time, and longer than `BRIDGED_GAP_MAX_NS`.
    """
    return max(LONG_GAP_NS, min(BRIDGED_GAP_MAX_NS, int(GAP_SHARE_MAX * duration_ns)))


def _measure_ns(pieces: list[Contact]) -> int:
    return pieces[-1].last.t_ns - pieces[0].first.t_ns


def _split_at_long_gaps(pieces: list[Contact]) -> list[list[Contact]]:
    """Split contacts into stances: at the longest gap if it is not short, then each half again."""
    gaps_ns = [after.first.t_ns - before.last.t_ns for before, after in pairwise(pieces)]
    if not gaps_ns or max(gaps_ns) <= _limit_gap_ns(_measure_ns(pieces)):
        return [pieces]
    at = gaps_ns.index(max(gaps_ns)) + 1
    return [*_split_at_long_gaps(pieces[:at]), *_split_at_long_gaps(pieces[at:])]


def _join_contacts(pieces: list[Contact]) -> Contact:
    first, *others = pieces
    for other in others:
        first.join(other)
    return first


def _make_stance(contact: Contact, number: int, behind: Frame | None) -> Stance:
    """Make the stance; `behind` is the next frame with known contact, if it has none."""
    duration_ns = contact.last.t_ns - contact.first.t_ns
    limit_ns = _limit_gap_ns(duration_ns)
    if contact.before is not None and not contact.first.is_near(contact.before, limit_ns):
        contact.before = None
    if not contact.last.is_near(behind, limit_ns):
        behind = None
    edges = contact.add_edge_gaps(behind)
    gap_s = contact.gaps.total_s + edges.total_s
    peak_n, peak_t_ns, peak_sigma_n = contact.estimate_peak(edges)
    x_first_m, x_last_m = contact.cop_x_m or (np.nan, np.nan)
    range_m, range_sigma_m = contact.compute_cop_range_m(edges)
    has_impulse = (
        not contact.status & EstimateFlag.SATURATED
        and gap_s <= GAP_SHARE_MAX * duration_ns * 1e-9
        and np.isfinite([contact.first.grf_n, contact.last.grf_n]).all()
    )
    return Stance(
        number=number,
        part=contact.first.part,
        begin_t_ns=contact.first.t_ns,
        end_t_ns=contact.last.t_ns,
        duration_sigma_s=contact.compute_duration_sigma_s(behind),
        peak_grf_n=peak_n,
        peak_t_ns=peak_t_ns,
        peak_sigma_n=peak_sigma_n,
        impulse_n_s=contact.integrals[0] if has_impulse else np.nan,
        impulse_sigma_n_s=contact.compute_impulse_sigma_n_s(behind) if has_impulse else np.nan,
        cop_x_first_m=x_first_m,
        cop_x_last_m=x_last_m,
        cop_x_range_m=range_m,
        cop_x_range_sigma_m=range_sigma_m,
        frames=contact.frames,
        unknown_frames=contact.unknown,
        missing_frames=contact.last.seq - contact.first.seq + 1 - contact.frames,
        gap_s=gap_s,
        estimate_flags=contact.status,
        begun=contact.before is not None,
        ended=behind is not None,
    )
