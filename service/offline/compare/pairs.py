"""Our frames with what the reference says at the same instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Times
from service.estimation.stances import GATHERED
from service.offline.accuracy import GRF_FROM_N
from service.offline.compare.align import Alignment
from service.offline.compare.blocks import Estimate, mean_of
from service.offline.compare.signals import Signal

COMPARED = ("seq", "t_ns", *GATHERED, "cop_y_m", "cop_sigma_y_m")
"""Columns of a session that are compared."""

CONTACT_SIGMA = 5.0
"""The reference bears load above so many sigma of its noise without load, as for our contact."""
SETTLE_S = 0.02
"""A frame in flight is this far from any contact: averaging is over, and ringing nearly."""
SAME_RATE = 1.05
"""Steps that differ by less are of one rate."""
FLIGHT_MIN = 50
"""Frames in flight from which a zero can be told."""

Columns = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Reference:
    """What a reference has measured, in SI units and with our signs.

    Attributes:
        force: vertical force of the ground on the foot.
        cop_m: (n, 2), in the foot frame; NaN where it is not stated; None if it never is.
    """

    force: Signal
    cop_m: Floats | None = None

    def cop_at(self, t_s: Floats) -> Floats:
        """Centre of pressure at instants (m,), (m, 2); NaN unless both samples beside state it."""
        if self.cop_m is None:
            return np.full((len(t_s), 2), np.nan)
        known = self.force.known_at(t_s)
        both = [np.interp(t_s, self.force.t_s, column) for column in self.cop_m.T]
        return np.where(known[:, None], np.stack(both, axis=1), np.nan)


@dataclass(frozen=True)
class Pairs:
    """Frames of ours at which the reference is known, n of them.

    Attributes:
        columns: ours, `COMPARED`.
        t_s: (n,), since the first frame of the session.
        reference_n: (n,), its force; less its zero, if that was asked for.
        reference_cop_m: (n, 2).
        contact: (n,), the reference bears load.
        contact_n: above how many newtons over its zero it does.
        lag_n: (n,), what the lag's uncertainty makes of the reference's force: its rate of change
            times that.
        judged: (n,), frames that count: all, or of a reference that is slower than ours those
            nearest to its samples, so that none of these counts twice.
        zero_n: what the reference reads in flight; None if it was never in flight long enough.
        removed: whether that was taken off.
    """

    columns: Columns
    t_s: Floats
    reference_n: Floats
    reference_cop_m: Floats
    contact: Bools
    contact_n: float
    lag_n: Floats
    judged: Bools
    zero_n: Estimate | None
    removed: bool

    @property
    def zero_left_n(self) -> float:
        """What is still in `reference_n` where nothing presses."""
        return 0.0 if self.removed or self.zero_n is None else self.zero_n.value

    @property
    def error_n(self) -> Floats:
        """Ours less the reference, (n,); NaN where our GRF is not known."""
        return np.asarray(self.columns["grf_n"] - self.reference_n)


def seconds_of(t_ns: Times) -> Floats:
    """Seconds since the first frame."""
    return np.asarray((t_ns - t_ns[0]) * 1e-9)


def pair(
    columns: Columns,
    reference: Reference,
    alignment: Alignment,
    *,
    remove_offset: bool = False,
    contact_n: float | None = None,
) -> Pairs:
    """Put the reference beside our frames.

    Args:
        columns: `COMPARED` of a session, one value per frame.
        reference: it.
        alignment: of the two.
        remove_offset: take off what the reference reads in flight.
        contact_n: above how many newtons the reference bears load; None: `CONTACT_SIGMA` of its
            noise in flight, and `GRF_FROM_N` at least.
    """
    t_s = seconds_of(columns["t_ns"])
    to_s = alignment.reference_s(t_s)
    force = reference.force
    both_n = force.at(to_s)
    zero_n, noise_n = _flight(t_s, columns["contact"], both_n)
    level_n = 0.0 if zero_n is None else zero_n.value
    if contact_n is None:
        contact_n = max(GRF_FROM_N, CONTACT_SIGMA * noise_n)
    there = np.isfinite(both_n)
    rate = np.gradient(force.force_n, force.t_s)
    lag_n = np.abs(np.interp(to_s, force.t_s, rate)) * alignment.lag_sigma_s(t_s)
    return Pairs(
        columns={name: values[there] for name, values in columns.items()},
        t_s=t_s[there],
        reference_n=both_n[there] - (level_n if remove_offset else 0.0),
        reference_cop_m=reference.cop_at(to_s[there]),
        contact=both_n[there] - level_n > contact_n,
        contact_n=contact_n,
        lag_n=lag_n[there],
        judged=_nearest(to_s[there], force.t_s),
        zero_n=zero_n,
        removed=remove_offset and zero_n is not None,
    )


def _flight(
    t_s: Floats, contact: npt.NDArray[np.uint8], reference_n: Floats
) -> tuple[Estimate | None, float]:
    """Zero of the reference, and its noise, where our foot is in flight."""
    loaded_s = t_s[contact != 0]
    flying = (contact == 0) & np.isfinite(reference_n)
    if len(loaded_s):
        after = np.searchsorted(loaded_s, t_s)
        behind_s = loaded_s[np.minimum(after, len(loaded_s) - 1)] - t_s
        before_s = t_s - loaded_s[np.maximum(after - 1, 0)]
        flying &= ~((np.abs(behind_s) < SETTLE_S) | (np.abs(before_s) < SETTLE_S))
    rows = np.flatnonzero(flying)
    if len(rows) < FLIGHT_MIN:
        return None, 0.0
    values_n = reference_n[rows]
    # Contacts that only the reference has seen are none of its noise.
    middle_n = np.median(values_n)
    noise_n = 1.4826 * float(np.median(np.abs(values_n - middle_n)))
    quiet = np.abs(values_n - middle_n) <= max(CONTACT_SIGMA * noise_n, GRF_FROM_N)
    if quiet.sum() < FLIGHT_MIN:
        return None, noise_n
    return mean_of(values_n[quiet], np.arange(int(quiet.sum()))), noise_n


def _nearest(at_s: Floats, samples_s: Floats) -> Bools:
    """Which of n instants count: all if samples are closer than they, else the nearest to each."""
    if len(at_s) < 2 or not (np.median(np.diff(samples_s)) > SAME_RATE * np.median(np.diff(at_s))):
        return np.ones(len(at_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(at_s, samples_s), 1, len(at_s) - 1)
    nearer = np.where(samples_s - at_s[after - 1] < at_s[after] - samples_s, after - 1, after)
    inside = (samples_s >= at_s[0]) & (samples_s <= at_s[-1])
    judged = np.zeros(len(at_s), dtype=np.bool_)
    judged[nearer[inside]] = True
    return judged
