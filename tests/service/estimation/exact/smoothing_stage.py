"""The smoothing stage at fifty digits: averages, the flowing branch, loop and creep.

Written from the docstrings of the models and the design, not from the code.
"""

from __future__ import annotations

from typing import Any

from mpmath import mp, mpf

from devices.arrays import Floats
from service.estimation.models import denoise
from service.estimation.models.hysteresis import LOOP_OPENING, WIDTHS_N
from tests.service.estimation.exact.digits import Exact
from tests.service.estimation.exact.sample_stage import AWAY_NS


def rubber(
    apparent: list[Exact],
    t_ns: list[int],
    parts: list[Exact],
    taus_s: list[Exact],
    loads: list[Exact] | None = None,
    away: Exact = None,
) -> list[Exact]:
    """`apparent = F - sum g (F - z)`, `tau z' = F - z`, F linear between readings, 0 at first.

    The dome creeps under `loads` where they are not None. In a gap its load was `away`, or nothing,
    the farther one, until the gap's end.
    """
    z = [mpf(0) for _ in parts]
    before, before_ns = mpf(0), None
    out: list[Exact] = []
    for value, now_ns in zip(apparent, t_ns, strict=True):
        if value is None:
            out.append(None)
            continue
        passed = mpf(max(0, now_ns - before_ns)) / 10**9 if before_ns is not None else mpf(0)
        # z after the step is decayed + share F, linear in the unknown F.
        decayed, share = [], []
        absent = away is not None and passed * 10**9 > AWAY_NS
        for m, tau in enumerate(taus_s if not absent else ()):
            h = passed / tau
            decay = mp.exp(-h)
            mean = (1 - decay) / h if h != 0 else mpf(1)
            decayed.append(decay * z[m] + (mean - decay) * before)
            share.append(1 - mean)
        if absent:
            load = max((away, mpf(0)), key=lambda f: abs(f - (before + value) / 2))
            decayed = [
                x * mp.exp(-passed / tau) + load * (1 - mp.exp(-passed / tau))
                for x, tau in zip(z, taus_s, strict=True)
            ]
            share = [mpf(0) for _ in taus_s]
        left = 1 - sum(g * (1 - s) for g, s in zip(parts, share, strict=True))
        force = (value - sum(g * x for g, x in zip(parts, decayed, strict=True))) / left
        out.append(force)
        if loads is not None and loads[len(out) - 1] is not None:
            force = loads[len(out) - 1]
        z = [x + s * force for x, s in zip(decayed, share, strict=True)]
        before, before_ns = force, now_ns
    return out


def flow(
    apparent: list[Exact],
    t_ns: list[int],
    part: Exact,
    stress: Exact,
    power: Exact,
    loads: list[Exact] | None = None,
    away: Exact = None,
) -> list[Exact]:
    """`apparent = F - s`, `s' = g F' - 10 g |s/S|^n sign(s)`: the flow between two half changes.

    The branch flows under `loads` where they are not None. In a gap its load was `away` or
    nothing, the farther one, until the gap's end: long enough for the branch to be at rest.
    """
    s, before, before_ns = mpf(0), mpf(0), None
    out: list[Exact] = []
    for value, now_ns in zip(apparent, t_ns, strict=True):
        if value is None:
            out.append(None)
            continue
        passed = max(mpf(0), mpf(now_ns - (now_ns if before_ns is None else before_ns)) / 10**9)
        if away is not None and passed * 10**9 > AWAY_NS:
            before = max((away, mpf(0)), key=lambda f: abs(f - (before + value) / 2))
            s, passed = mpf(0), mpf(0)

        def after(
            force: Exact, s: Exact = s, before: Exact = before, passed: Exact = passed
        ) -> Exact:
            half = part * (force - before) / 2
            between = s + half
            if between != 0:  # s^-(n - 1) grows evenly
                more = power - 1
                grown = abs(between) ** -more + more * 10 * part * passed / stress**power
                between = mp.sign(between) * grown ** (-1 / more)
            return between + half

        # The addition hardly changes with the force, so iteration converges.
        force = value
        for _ in range(400):
            better = value + after(force)
            if better == force:
                break
            force = better
        out.append(force)
        if loads is not None and loads[len(out) - 1] is not None:
            force = loads[len(out) - 1]
        s, before, before_ns = after(force), force, now_ns
    return out


def hysteresis(
    apparent: list[Exact], parts: list[Exact], loads: list[Exact] | None = None
) -> list[Exact]:
    """`apparent = F + sum w (y - F)` solved on the pieces of the broken line that it is.

    Plays follow `loads` where they are not None.
    """
    opens, widths = mpf(LOOP_OPENING), [mpf(float(w)) for w in WIDTHS_N]

    def play(force: Exact, width: Exact, before: Exact) -> Exact:
        half = min(width, opens * max(force, mpf(0)))
        return min(max(before, force - half), force + half)

    plays = [mpf(0) for _ in widths]
    out: list[Exact] = []
    for value in apparent:
        if value is None:
            out.append(None)
            continue

        def lagging(force: Exact, plays: list[Exact] = plays) -> Exact:
            moved = zip(parts, widths, plays, strict=True)
            return force + sum(g * (play(force, w, y) - force) for g, w, y in moved)

        kinks = {mpf(0)}
        for width, y in zip(widths, plays, strict=True):
            kinks |= {width / opens, y / (1 + opens), y / (1 - opens), y - width, y + width}
        places = [min(kinks) - 1, *sorted(kinks), max(kinks) + 1]
        right = next((i for i in range(1, len(places) - 1) if lagging(places[i]) >= value), -1)
        a, b = places[right - 1], places[right]
        slope = (lagging(b) - lagging(a)) / (b - a)
        force = a + (value - lagging(a)) / slope
        out.append(force)
        if loads is not None and loads[len(out) - 1] is not None:
            force = loads[len(out) - 1]
        plays = [play(force, w, y) for w, y in zip(widths, plays, strict=True)]
    return out


def curve_at_zero(x: list[Exact], y: list[Exact], degree: int) -> tuple[Exact, Exact] | None:
    """Fit a curve; return its value at 0 and the variance, or None without enough points."""
    if len(x) < degree + 2:
        return None
    # Orthogonal polynomials (Gram-Schmidt), so that normal equations are not shared.
    basis: list[list[Exact]] = []
    at_zero: list[Exact] = []
    determinant = mpf(1)
    for k in range(degree + 1):
        column, zero = [v**k for v in x], mpf(1 if k == 0 else 0)
        for q, q0 in zip(basis, at_zero, strict=True):
            share = mp.fdot(column, q) / mp.fdot(q, q)
            column = [a - share * b for a, b in zip(column, q, strict=True)]
            zero -= share * q0
        norm = mp.fsum(v ** (2 * k) for v in x)
        determinant *= mp.fdot(column, column) / norm if norm != 0 else 0
        if determinant <= mpf(denoise.DETERMINANT_MIN):
            return None
        basis.append(column)
        at_zero.append(zero)
    pairs = list(zip(basis, at_zero, strict=True))
    value = sum(q0 * mp.fdot(q, y) / mp.fdot(q, q) for q, q0 in pairs)
    return value, sum(q0**2 / mp.fdot(q, q) for q, q0 in pairs)


def _between(table: Floats, at: Any) -> Any:
    """Interpolate linearly."""
    below = min(int(mp.floor(at)), len(table) - 2)
    first, second = mpf(table[below]), mpf(table[below + 1])
    return first + (at - below) * (second - first)


def _agree(value: Any, variance: Any, degree: int, shorter: list[Any], sigma: Exact) -> bool:
    """Return whether a window agrees with each shorter one (value, variance, degree)."""
    for before, of_before, degree_before in shorter:
        nested = degree <= degree_before
        less = max(of_before - variance, mpf(denoise.VARIANCE_REDUCTION_MIN) * of_before)
        allowed = less if nested else of_before + variance
        if (value - before) ** 2 > (denoise.AGREEMENT_SIGMAS * sigma) ** 2 * allowed:
            return False
    return True


def denoised(
    values: list[Exact],
    sigmas: list[Exact],
    t_ns: list[int],
    frame_ns: list[int],
    at_ns: list[int],
    run: list[int],
    look_ns: int,
    noise_left: Floats,
    within: list[Any] | None = None,
) -> list[Any]:
    """Windows that grow on either side, a parabola and a line in each, as long as they agree.

    Returns of each value: average, variance, difference to half the window, variance of that, and
    the rows of the longest straight window and of the longest: `within` such rows other columns
    take lines and grow.
    """
    out: list[Any] = []
    for i, as_read in enumerate(values):
        if as_read is None:
            out.append(None)
            continue
        own, sigma = as_read, sigmas[i]
        reachable = [
            j
            for j in range(len(values))
            if run[j] == run[i]
            and frame_ns[i] - denoise.PAST_NS
            <= frame_ns[j]
            <= max(frame_ns[i] + look_ns, frame_ns[i])
        ]
        way = -1 if at_ns[i] < t_ns[i] else 1
        k = i
        while k + way in reachable and way * (at_ns[i] - t_ns[k + way]) > 0:
            k += way
        near, far = values[k], values[k + way] if k + way in reachable else None
        if near is not None and far is not None and t_ns[k + way] != t_ns[k]:
            moved = near + mpf(at_ns[i] - t_ns[k]) / (t_ns[k + way] - t_ns[k]) * (far - near)
            if abs(moved - own) > mpf(denoise.MOVE_SIGMAS) * sigma:
                own = moved
        lines: set[int] = set(reachable)
        if within is not None and within[i] is not None:
            lines, most = within[i]
            reachable = [j for j in reachable if j in most]
        history = [(own, mpf(1))] * 3
        shorter = [(own, mpf(1), 2)]
        straight, window, growing = True, {i}, [-1, 1]
        straight_window = {i}
        for reach in denoise.WINDOW_REACHES:
            best = history[-1]
            for side in (-1, 1):
                wider = window | {j for j in reachable if 0 <= side * (j - i) <= reach}
                if side not in growing or wider == window:
                    continue
                good = [j for j in sorted(wider) if values[j] is not None]
                x = [mpf(t_ns[j] - at_ns[i]) / 10**6 for j in good]
                y = [values[j] for j in good]
                accepted = None
                for degree in (2, 1) if straight and wider <= lines else (2,):
                    found = curve_at_zero(x, y, degree)
                    if found is None:
                        continue
                    value, variance = found
                    variance *= _between(noise_left, 1 / variance)
                    if not _agree(value, variance, degree, shorter, sigma):
                        straight = False
                        if degree == 2:
                            growing.remove(side)
                        break
                    shorter.append((value, variance, degree))
                    accepted = value, variance
                if side not in growing:
                    continue
                window = wider
                if straight:
                    straight_window = window
                if (
                    accepted is not None
                    and accepted[1] < (1 - mpf(denoise.VARIANCE_REDUCTION_MIN)) * best[1]
                ):
                    best = accepted
            if best[1] < history[-1][1]:
                history = [*history[1:], best]
        (value, variance), (old, old_variance) = history[-1], history[0]
        bend, of_bend = value - old, old_variance - variance
        if sigma > 0:
            variance += max(mpf(0), (bend / sigma) ** 2 - of_bend)
        out.append((value, variance, bend, of_bend, (straight_window, window)))
    return out


def shared_bend(bends_n: list[list[Exact]], noises_n: list[list[Exact]]) -> list[list[Exact]]:
    """Compute the part of each tile's bends beyond noise in the sum over tiles; None is missing."""
    out = [[mpf(0)] * len(bends_n[0]) for _ in bends_n]
    for k in range(len(bends_n[0])):
        there = [i for i, bends in enumerate(bends_n) if bends[k] is not None]
        total = mp.fsum(bends_n[i][k] for i in there)
        variance = mp.fsum(noises_n[i][k] ** 2 for i in there)
        if total**2 > mpf(denoise.AGREEMENT_SIGMAS) ** 2 * variance:
            for i in there:
                out[i][k] = mp.sqrt(1 - variance / total**2) * bends_n[i][k]
    return out
