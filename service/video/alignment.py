"""Alignment of a film with its session: offset and drift of the camera's clock, with uncertainty.

A method finds pairs: an instant of the film, the same instant in the session, and the standard
deviation of their difference. All pairs of a film are fitted by one line

    session t = begin + offset + (1 + drift) (film t - middle)

with the drift's own knowledge beforehand: crystals of cameras are within some 50 ppm. So one pair
gives an offset whose uncertainty grows away from it, and several pairs give the drift, too. A pair
that contradicts the others is left out, and said.
"""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.sessions.videos import Alignment, AlignmentMethod

DRIFT_SIGMA = 50e-6
"""Standard deviation of a camera's drift before anything is measured."""
_OUTLIER_SIGMAS = 4.0


def fit_alignment(
    method: AlignmentMethod, film_s: Floats, t_ns: Floats, sigma_ns: Floats, *, begin_t_ns: int
) -> Alignment:
    """Fit a line to pairs of instants.

    The greatest set of pairs that agree is sought from every pair, so that no wrong one leads; ties
    go to the lesser misfit. With two pairs that contradict each other there is no majority.

    Args:
        method: how the pairs were found.
        film_s: (pairs,), in s from the film's first picture.
        t_ns: (pairs,), in ns after `begin_t_ns`.
        sigma_ns: (pairs,), standard deviations of `t_ns`.
        begin_t_ns: begin of the session.

    Raises:
        FileFormatError: there is no pair, or no majority agrees.
    """
    if not len(film_s):
        raise FileFormatError(f"no instant of the film was found by {method}")
    # From one pair the others are as uncertain as both, and the drift between them.
    apart_s = film_s[None, :] - film_s[:, None]
    misfit_ns = np.abs(t_ns[None, :] - t_ns[:, None] - 1e9 * apart_s)
    allowed_ns = np.sqrt(
        sigma_ns[None, :] ** 2 + sigma_ns[:, None] ** 2 + (1e9 * DRIFT_SIGMA * apart_s) ** 2
    )
    ratio = misfit_ns / allowed_ns
    agree = ratio < _OUTLIER_SIGMAS
    votes = agree.sum(axis=1) - np.minimum(ratio, _OUTLIER_SIGMAS).sum(axis=1) / (
        _OUTLIER_SIGMAS * (len(film_s) + 1)
    )
    used = agree[int(np.argmax(votes))]
    if 2 * used.sum() <= len(film_s):
        raise FileFormatError(
            f"of {len(film_s)} instants found by {method} no majority agrees",
            remedy="Align by another method, or by hand",
        )
    x_s, y_ns, weight = film_s[used], t_ns[used], sigma_ns[used] ** -2.0
    middle_s = float(weight @ x_s / weight.sum())
    shifted_s = x_s - middle_s
    # A line about the weighted mean: offset and drift are independent.
    rest_ns = y_ns - 1e9 * shifted_s
    offset_ns = float(weight @ rest_ns / weight.sum())
    information = 1e18 * float(weight @ shifted_s**2) + DRIFT_SIGMA**-2.0
    drift = float(1e9 * (weight * shifted_s) @ (rest_ns - offset_ns)) / information
    return Alignment(
        method=method,
        film_s=middle_s,
        t_ns=begin_t_ns + round(offset_ns),
        drift=drift,
        sigma_ns=math.sqrt(1.0 / float(weight.sum())),
        sigma_drift=math.sqrt(1.0 / information),
        pair_count=int(used.sum()),
        rejected_count=int(len(film_s) - used.sum()),
    )
