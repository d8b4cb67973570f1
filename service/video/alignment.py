"""Alignment of a film with its session: offset and drift of the camera's clock, with uncertainty.

A method finds pairs: an instant of the film, the same instant in the session, and the standard
deviation of their difference. All pairs of a film are fitted by one line

    session t = begin + offset + (1 + drift) (film t - middle)

with the drift's own knowledge beforehand: crystals of cameras are within some 50 ppm, and a stated
capture rate within 0.1 % (240 may be 239.76). So one pair gives an offset whose uncertainty grows
away from it, and several pairs give the drift, too. A pair that contradicts the others is left out,
and said; the scatter of the others enlarges the uncertainties that they state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.sessions.videos import DRIFT_SIGMA, Alignment, AlignmentMethod

_OUTLIER_SIGMAS = 4.0


def fit_alignment(
    method: AlignmentMethod,
    film_s: Floats,
    t_ns: Floats,
    sigma_ns: Floats,
    *,
    begin_t_ns: int,
    common_ns: float = 0.0,
    drift_sigma: float = DRIFT_SIGMA,
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
        common_ns: standard deviation of an error that all pairs share, or those of one end.
        drift_sigma: standard deviation of the drift beforehand.

    Raises:
        FileFormatError: there is no pair, or no majority agrees.
    """
    if not len(film_s):
        raise FileFormatError(f"no instant of the film was found by {method}")
    _, rows = np.unique(np.stack([film_s, t_ns]), axis=1, return_index=True)
    film_s, t_ns, sigma_ns = film_s[rows], t_ns[rows], sigma_ns[rows]
    # From one pair the others are as uncertain as both, and the drift between them.
    apart_s = film_s[None, :] - film_s[:, None]
    misfit_ns = np.abs(t_ns[None, :] - t_ns[:, None] - 1e9 * apart_s)
    allowed_ns = np.sqrt(
        sigma_ns[None, :] ** 2 + sigma_ns[:, None] ** 2 + (1e9 * drift_sigma * apart_s) ** 2
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
            remedy="Look for the wrong ones, or align by another method",
        )
    x_s, y_ns, weight = film_s[used], t_ns[used], sigma_ns[used] ** -2.0
    middle_s = float(weight @ x_s / weight.sum())
    shifted_s = x_s - middle_s
    # A line about the weighted mean: offset and drift are independent.
    rest_ns = y_ns - 1e9 * shifted_s
    offset_ns = float(weight @ rest_ns / weight.sum())
    information = 1e18 * float(weight @ shifted_s**2) + drift_sigma**-2.0
    drift = float(1e9 * (weight * shifted_s) @ (rest_ns - offset_ns)) / information
    left_ns = rest_ns - offset_ns - 1e9 * drift * shifted_s
    scatter = math.sqrt(max(1.0, float(weight @ left_ns**2) / max(1, used.sum() - 1)))
    common_drift = math.sqrt(2.0) * 1e-9 * common_ns / max(float(np.ptp(x_s)), 1e-9)
    return Alignment(
        method=method,
        film_s=middle_s,
        t_ns=begin_t_ns + round(offset_ns),
        drift=drift,
        sigma_ns=math.hypot(scatter * float(weight.sum()) ** -0.5, common_ns),
        sigma_drift=min(drift_sigma, math.hypot(scatter * information**-0.5, common_drift)),
        pair_count=int(used.sum()),
        rejected_count=int(len(film_s) - used.sum()),
    )


_MISS_COST = 3.0
"""Cost of a touchdown without a contact, or the reverse: one in twenty is missed."""
_STEP_S = 0.5
"""Typical time between steps: the shorter an agreement against it, the more it says."""
_CERTAIN_BY = 3.0
"""Least lead of the best match over one by another step: odds of 20."""
_SAME_S = 0.05
_AGREE_MIN = 2
"""Touchdowns that have to agree before those outside the session count as possible."""
_FIRST_TOUCHDOWNS = 12
"""Touchdowns with which matches are tried: the first ones; some may be wrong."""


class Instants(NamedTuple):
    """Touchdowns of a film, or contacts of a session: instants in s, rising, and their sigmas."""

    at_s: Floats
    sigma_s: Floats
    duration_s: float
    """Time that the film or session covers, from 0."""
    drift_sigma: float = DRIFT_SIGMA
    """Standard deviation of its clock's drift."""
    is_complete: bool = True
    """False: some were chosen, and the film shows more."""


class _Match(NamedTuple):
    """Match by one touchdown that is some contact."""

    score: float
    """Log likelihood against a match by chance."""
    possible: float
    """Score if touchdowns outside the session agreed, too: a robot repeats its steps."""
    offset_s: float
    pairs: list[tuple[int, int]]


def match_contacts(
    touchdowns: Instants, contacts: Instants, near_s: tuple[float, float] = (-math.inf, math.inf)
) -> list[tuple[int, int]]:
    """Match touchdowns in a film with contacts in a session; either may lack some.

    Each of the first touchdowns is tried with every contact. The others then agree within their
    uncertainties and the drift, or were missed. A touchdown outside the session costs nothing, but
    a match is certain only if it leads both without these and as if all of them agreed: a film that
    begins before the session shows the same steps earlier.

    Args:
        touchdowns: of the film, in s from its first picture.
        contacts: of the session, in s from its begin.
        near_s: earliest and latest instant of the film's first picture, in s from that begin.

    Returns:
        Indices of each touchdown and its contact.

    Raises:
        FileFormatError: nothing agrees, or steps are so alike that another match is as likely.
    """
    matches: list[_Match] = []
    for first in range(min(len(touchdowns.at_s), _FIRST_TOUCHDOWNS)):
        for contact in range(len(contacts.at_s)):
            offset_s = float(contacts.at_s[contact] - touchdowns.at_s[first])
            if near_s[0] <= offset_s <= near_s[1]:
                matches.append(_match_by(touchdowns, contacts, first, contact))
    best = max(matches, key=lambda match: match.score, default=_Match(0.0, 0.0, 0.0, []))
    rivals = [match for match in matches if abs(match.offset_s - best.offset_s) > _SAME_S]
    lead = min(
        best.score - max((rival.score for rival in rivals), default=-math.inf),
        best.possible - max((rival.possible for rival in rivals), default=-math.inf),
    )
    if best.score <= 0.0 or lead < _CERTAIN_BY:
        count = f"{len(touchdowns.at_s)} touchdowns and {len(contacts.at_s)} contacts"
        raise FileFormatError(
            f"{count} do not agree" if best.score <= 0.0 else f"{count} agree in more than one way",
            expected="steps of which the times in between differ, or a film of all of them",
            remedy="Say about when the film begins with --near, as exactly as --within says, or "
            "align by another method",
        )
    return best.pairs


def _match_by(touchdowns: Instants, contacts: Instants, first: int, contact: int) -> _Match:
    """Match the others if one touchdown is that contact."""
    since_s = touchdowns.at_s - touchdowns.at_s[first]
    expected_s = contacts.at_s[contact] + since_s
    right = np.minimum(np.searchsorted(contacts.at_s, expected_s), len(contacts.at_s) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(contacts.at_s[left] - expected_s) < np.abs(contacts.at_s[right] - expected_s)
    nearest = np.where(is_left, left, right)
    sigma_s = np.sqrt(
        touchdowns.sigma_s**2
        + contacts.sigma_s[nearest] ** 2
        + touchdowns.sigma_s[first] ** 2
        + contacts.sigma_s[contact] ** 2
        + (touchdowns.drift_sigma * since_s) ** 2
    )
    ratio = np.abs(contacts.at_s[nearest] - expected_s) / sigma_s
    agree = ratio < _OUTLIER_SIGMAS
    gain = np.log(_STEP_S / (math.sqrt(2.0 * math.pi) * sigma_s)) - 0.5 * ratio**2
    in_film_s = contacts.at_s - contacts.at_s[contact] + touchdowns.at_s[first]
    covered = (expected_s >= 0) & (expected_s <= contacts.duration_s)
    filmed = (in_film_s >= 0) & (in_film_s <= touchdowns.duration_s)
    filmed[nearest[agree]] = False
    misses = int((covered & ~agree).sum()) + int(touchdowns.is_complete) * int(filmed.sum())
    score = float(gain[agree].sum()) - _MISS_COST * misses
    outside = int((~covered & ~agree).sum()) * (agree.sum() >= _AGREE_MIN)
    return _Match(
        score=score,
        possible=score + float(gain[agree].mean()) * outside,
        offset_s=float(contacts.at_s[contact] - touchdowns.at_s[first]),
        pairs=[(int(row), int(nearest[row])) for row in np.flatnonzero(agree)],
    )


def describe_contradiction(old: Alignment, new: Alignment) -> str:
    """Describe how far two alignments of a film are apart; empty within their uncertainties."""
    at_s = np.array([new.film_s])
    apart_ns = float(old.t_ns - new.t_ns + old.to_session_ns(at_s)[0])
    sigma_ns = math.hypot(float(old.compute_sigma_ns(at_s)[0]), new.sigma_ns)
    if abs(apart_ns) < _OUTLIER_SIGMAS * sigma_ns:
        return ""
    return (
        f"the film is {abs(apart_ns) * 1e-6:.1f} ms {'earlier' if apart_ns > 0 else 'later'} by "
        f"{new.method} than by {old.method}, of which {2 * sigma_ns * 1e-6:.1f} ms are uncertain"
    )
