"""Two forces over time, as alignment needs them: evenly sampled, low-passed alike, gaps known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from devices.arrays import Bools, Floats, Ints
from devices.errors import ComparisonError

GAP_STEPS = 3.5
"""A step in time of so many usual ones is a gap: nothing is known in it."""

STEPS_MAX = 32_000_000
"""An hour of a foot at 544 Hz beside a plate of any rate; some 2 GB while it is resampled."""


@dataclass(frozen=True)
class Signal:
    """A force over time on a clock of its own.

    Attributes:
        t_s: (n,), rising.
        force_n: (n,), finite: samples without a force are left out, and are gaps then.
        sigma_n: (n,), its stated standard uncertainty, which may be the same from stance to stance;
            None: nothing is stated.
    """

    t_s: Floats
    force_n: Floats
    sigma_n: Floats | None = None

    @property
    def step_s(self) -> float:
        """The usual time between two samples."""
        return float(np.median(np.diff(self.t_s)))

    def known_at(self, t_s: Floats) -> Bools:
        """Whether instants (m,) lie between two samples with no gap between them."""
        after = np.searchsorted(self.t_s, t_s)
        inside = (after > 0) & (after < len(self.t_s))
        after = np.clip(after, 1, len(self.t_s) - 1)
        gap_s = self.t_s[after] - self.t_s[after - 1]
        exact = self.t_s[np.minimum(np.searchsorted(self.t_s, t_s), len(self.t_s) - 1)] == t_s
        return np.asarray(exact | (inside & (gap_s <= GAP_STEPS * self.step_s)))

    def at(self, t_s: Floats) -> Floats:
        """Force at instants (m,), straight between samples; NaN where it is not known."""
        force_n = np.interp(t_s, self.t_s, self.force_n)
        force_n[~self.known_at(t_s)] = np.nan
        return np.asarray(force_n, dtype=np.float64)


@dataclass(frozen=True)
class Even:
    """A signal at even steps, without the inside of long gaps; n samples.

    Attributes:
        begin_s: instant of step 0.
        step_s: between two steps.
        step: (n,), rising; number of the step of each sample. It jumps over long gaps.
        force_n: (n,); straight across where it is not known.
        known: (n,).
    """

    begin_s: float
    step_s: float
    step: Ints
    force_n: Floats
    known: Bools

    @property
    def t_s(self) -> Floats:
        """Instants of the samples."""
        return np.asarray(self.begin_s + self.step_s * self.step, dtype=np.float64)

    def known_at(self, t_s: Floats) -> Bools:
        """Tell whether the samples nearest to instants (m,) are known."""
        if not len(self.step):
            return np.zeros(len(t_s), dtype=np.bool_)
        step = np.rint((t_s - self.begin_s) / self.step_s)
        at = np.minimum(np.searchsorted(self.step, step), len(self.step) - 1)
        return np.asarray((self.step[at] == step) & self.known[at])


def even(
    signal: Signal,
    step_s: float,
    edge_steps: int,
    *,
    gap_s: float = 0.0,
    within_s: tuple[float, float] = (-np.inf, np.inf),
) -> Even:
    """Return a signal at even steps, straight between its samples.

    The size does not follow from how long a signal is, which one wrong time stamp decides, but from
    how much of it there is.

    Args:
        signal: the signal.
        step_s: between two steps.
        edge_steps: steps that are kept at either side of a long gap.
        gap_s: a gap that is longer, and longer than its edges, is long.
        within_s: nothing is returned of before and after.

    Raises:
        ComparisonError: there were more than `STEPS_MAX` steps.
    """
    place = (signal.t_s - signal.t_s[0]) / step_s
    long = np.diff(place) > max(2 * edge_steps + 2, gap_s / step_s)
    begins = np.concatenate([[0], np.floor(place[1:][long]).astype(np.int64) - edge_steps])
    ends = np.concatenate(
        [np.ceil(place[:-1][long]).astype(np.int64) + edge_steps, [int(place[-1])]]
    )
    low, high = np.clip((np.array(within_s) - signal.t_s[0]) / step_s, 0.0, place[-1])
    begins, ends = np.maximum(begins, int(low)), np.minimum(ends, int(high))
    lengths = np.maximum(0, ends - begins + 1)
    count = int(lengths.sum())
    if count > STEPS_MAX:
        raise ComparisonError(
            f"{count} steps of {step_s:.3g} s are too many to be compared",
            expected=f"up to {STEPS_MAX}",
            remedy="Cut out the part that both have recorded",
        )
    before = np.cumsum(lengths) - lengths
    step = np.arange(count) + np.repeat(begins - before, lengths)
    t_s = signal.t_s[0] + step_s * step
    force_n = np.interp(t_s, signal.t_s, signal.force_n)
    return Even(float(signal.t_s[0]), step_s, step, force_n, signal.known_at(t_s))


def smooth(
    signal: Signal,
    width_s: float,
    step_s: float,
    margin_s: float = 0.0,
    within_s: tuple[float, float] = (-np.inf, np.inf),
) -> Even:
    """A signal under a Gaussian window, at even steps.

    Two signals under the same window are as far apart in time as before, while their noise has no
    say in where between two samples they fit best: straight lines between noisy samples do.

    Args:
        signal: the signal.
        width_s: standard deviation of the window.
        step_s: of the result; at most half the width.
        margin_s: further than the window that a known sample is away from any gap.
        within_s: nothing is returned of before and after.
    """
    reach = round((3.0 * width_s + margin_s) / step_s)
    # The window reaches over four of its widths: no sample that is known sees beyond an edge.
    edge_steps = reach + round(4.0 * width_s / step_s)
    raw = even(signal, step_s, edge_steps, within_s=within_s)
    known = minimum_filter1d(raw.known.view(np.uint8), 2 * reach + 1, mode="constant", cval=0)
    force_n = gaussian_filter1d(raw.force_n, width_s / step_s, mode="nearest")
    return replace(raw, force_n=force_n, known=known.astype(np.bool_))
