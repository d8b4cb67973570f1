"""Two forces over time, as alignment needs them: evenly sampled, low-passed alike, gaps known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from devices.arrays import Bools, Floats

GAP_STEPS = 3.5
"""A step in time of so many usual ones is a gap: nothing is known in it."""


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
    """A signal at even steps.

    Attributes:
        begin_s: instant of the first sample.
        step_s: between two.
        force_n: (n,); where it is not known straight across.
        known: (n,).
    """

    begin_s: float
    step_s: float
    force_n: Floats
    known: Bools

    @property
    def t_s(self) -> Floats:
        """Instants of the samples."""
        steps = np.arange(len(self.force_n))
        return np.asarray(self.begin_s + self.step_s * steps, dtype=np.float64)


def even(signal: Signal, step_s: float) -> Even:
    """A signal at even steps, straight between its samples."""
    steps = int((signal.t_s[-1] - signal.t_s[0]) / step_s)
    t_s = signal.t_s[0] + step_s * np.arange(steps + 1)
    return Even(
        float(signal.t_s[0]),
        step_s,
        np.interp(t_s, signal.t_s, signal.force_n),
        signal.known_at(t_s),
    )


def smooth(signal: Signal, width_s: float, step_s: float, margin_s: float = 0.0) -> Even:
    """A signal under a Gaussian window, at even steps.

    Two signals under the same window are as far apart in time as before, while their noise has no
    say in where between two samples they fit best: straight lines between noisy samples do.

    Args:
        signal: the signal.
        width_s: standard deviation of the window.
        step_s: of the result; at most half the width.
        margin_s: further than the window that a known sample is away from any gap.
    """
    raw = even(signal, step_s)
    reach = round((3.0 * width_s + margin_s) / step_s)
    known = minimum_filter1d(raw.known.view(np.uint8), 2 * reach + 1, mode="constant", cval=0)
    force_n = gaussian_filter1d(raw.force_n, width_s / step_s, mode="nearest")
    return Even(raw.begin_s, step_s, force_n, known.astype(np.bool_))
