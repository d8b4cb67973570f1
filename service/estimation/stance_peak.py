"""Peak force of a stance, without the bias of the largest of many noisy frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times

MAX_HALF_WIDTH = 256
"""Frames to either side in the widest window."""
_CHUNK = 4096
"""Number of frames that are searched together: a longer stance needs no more memory."""
_AGREEMENT_SIGMAS = 1.0
_SELECTION_SIGMAS = 6.0
_NOISE_CAP = 8.0
_CENTRES_PER_HALF = 8
"""Number of windows with centres within half the width of one; all frames, if they are fewer."""


@dataclass(frozen=True)
class _Candidate:
    """Estimate of the peak from one window; squared sigmas in N²."""

    lower_n: float = -math.inf
    force_n: float = math.nan
    t_ns: int = 0
    independent_n2: float = math.nan
    common_n2: float = math.nan
    frames: int = 1


class StancePeak(NamedTuple):
    """Peak of a force: its node's UTC, and standard uncertainty."""

    force_n: float
    t_ns: int
    sigma_n: float


class PeakSearch:
    """Search for the peak of a force in the consecutive frames of a stance.

    Parabolas over time are fitted to windows of the frames i - h to i + h, h = 0, 2, 4, 8, ...
    (Savitzky and Golay 1964). At frame i their value is a_h = sum(c_j f_j), with the noise
    v_h = sqrt(sum(c_j² q_j²)). A window counts if it agrees with all narrower windows k,
    |a_h - a_k| <= v_k (Lepski 1991). The peak is the a_h with the largest lower bound
    a_h - 6 v_h: 6 sigmas exceed the noise of the largest of many thousand frames (Duembgen and
    Spokoiny 2001), so only a significantly larger force is taken from a narrower window.

    The residuals of parabolas through five frames give the variance q² of independent noise. A
    frame's sigma also contains errors that it shares with its neighbours, so its noise q_j is
    sigma_j, but at most 8 q. In the mean of sigma_j² over the window q² averages out, the rest does
    not. One of n / (2h + 1) windows was chosen for its noise, hence the logarithm:

        sigma² = max(mean(sigma_j²) - q², 0) + q² sum(c_j²) (1 + 2 ln(n / (2h + 1)))

    Of fewer than five frames the peak is the largest, with its sigma. The result does not depend
    on the batches.
    """

    def __init__(self) -> None:
        self._t_ns: Times = np.empty(0, np.int64)
        self._forces: Floats = np.empty((2, 0))
        self._frames = 0
        self._best = _Candidate()

    def add_frames(self, t_ns: Times, grf_n: Floats, sigma_n: Floats) -> None:
        """Add the next n frames, (n,) each; frames without a force are left out."""
        known = np.isfinite(grf_n) & np.isfinite(sigma_n)
        self._frames += int(np.count_nonzero(known))
        self._t_ns = np.append(self._t_ns, t_ns[known])
        self._forces = np.append(self._forces, [grf_n[known], sigma_n[known]], axis=1)
        while len(self._t_ns) >= _CHUNK + 2 * MAX_HALF_WIDTH:
            self._search(slice(0, _CHUNK + 2 * MAX_HALF_WIDTH))
            self._t_ns, self._forces = self._t_ns[_CHUNK:], self._forces[:, _CHUNK:]

    def estimate_peak(self) -> StancePeak | None:
        """Estimate the peak so far; None without a force."""
        if not self._frames:
            return None
        self._search(slice(None))
        best = self._best
        selection = 1.0 + 2.0 * math.log(self._frames / best.frames)
        variance = best.common_n2 + best.independent_n2 * selection
        return StancePeak(best.force_n, best.t_ns, math.sqrt(variance))

    def _search(self, rows: slice) -> None:
        """Replace the best candidate if one of these frames has a better one."""
        t_ns, (force_n, sigma_n) = self._t_ns[rows], self._forces[:, rows]
        noise_n2 = _estimate_noise_n2(t_ns, force_n)
        capped_n2 = np.minimum(sigma_n**2, _NOISE_CAP**2 * noise_n2)
        centres = np.arange(len(force_n))  # at which all windows so far agree
        narrower = np.empty((2, 0, len(centres)))  # values and noises, (windows, centres)
        half = 0
        while half <= MAX_HALF_WIDTH:
            is_used = (centres >= half) & (centres < len(force_n) - half)
            is_used &= centres % max(1, half // _CENTRES_PER_HALF) == 0
            most_n = narrower[0] + _AGREEMENT_SIGMAS * narrower[1]  # of a window that agrees
            is_used &= np.all(most_n > self._best.lower_n, axis=0)
            centres, narrower = centres[is_used], narrower[..., is_used]
            frames, weights = _fit_parabolas(t_ns, centres, half)
            value_n = np.sum(weights * force_n[frames], axis=1)
            scatter_n = np.sqrt(np.sum(weights**2 * capped_n2[frames], axis=1))
            agrees = np.abs(value_n - narrower[0]) <= _AGREEMENT_SIGMAS * narrower[1]
            is_used = np.all(agrees, axis=0)
            if not is_used.any():
                return
            narrower = np.append(narrower, [[value_n], [scatter_n]], axis=1)[..., is_used]
            centres, (value_n, scatter_n) = centres[is_used], narrower[:, -1]
            lower_n = value_n - _SELECTION_SIGMAS * scatter_n
            at = int(np.argmax(lower_n))
            if lower_n[at] > self._best.lower_n:
                sigma_n2 = float(np.mean(sigma_n[frames[is_used][at]] ** 2))
                self._best = _Candidate(
                    float(lower_n[at]),
                    float(value_n[at]),
                    int(t_ns[centres[at]]),
                    float(np.sum(weights[is_used][at] ** 2)) * min(noise_n2, sigma_n2),
                    max(sigma_n2 - noise_n2, 0.0),
                    2 * half + 1,
                )
            half = max(2, 2 * half)


def _fit_parabolas(t_ns: Times, centres: npt.NDArray[np.intp], half: int) -> tuple[Any, Floats]:
    """Return frames (k, 2 half + 1) of windows about centres, and weights of their parabolas."""
    frames = centres[:, None] + np.arange(-half, half + 1)
    if half == 0:
        return frames, np.ones(frames.shape)
    x = (t_ns[frames] - t_ns[centres][:, None]) / (t_ns[frames[:, -1:]] - t_ns[frames[:, :1]])
    x2 = x * x
    s1, s2, s3, s4 = (np.sum(of, axis=1, keepdims=True) for of in (x, x2, x * x2, x2 * x2))
    # First row of the inverse of the normal equations, by cofactors.
    weights = (s2 * s4 - s3 * s3) + (s2 * s3 - s1 * s4) * x + (s1 * s3 - s2 * s2) * x2
    return frames, weights / np.sum(weights, axis=1, keepdims=True)


def _estimate_noise_n2(t_ns: Times, force_n: Floats) -> float:
    """Return the variance of independent noise about parabolas through five frames; 0 of fewer."""
    centres = np.arange(2, len(force_n) - 2)
    if not len(centres):
        return 0.0
    frames, weights = _fit_parabolas(t_ns, centres, 2)
    residual_n = force_n[2:-2] - np.sum(weights * force_n[frames], axis=1)
    return float(np.sum(residual_n**2) / np.sum(1.0 - weights[:, 2]))
