"""The full ladder at fifty digits, from counts to forces with their uncertainty.

This reference chooses windows itself. Three domes and a bare tile.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from mpmath import mp, mpf

from devices.frames import NOT_READ, FrameBatch
from service.estimation.calibration import TileCalibration
from service.estimation.models.denoise import OUTLIER_SIGMAS
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.pipeline.smoothing_stage import BOUND_SIGMAS
from tests.service.estimation.exact import sample_stage, smoothing_stage
from tests.service.estimation.exact.digits import Exact

DOMES = range(3)


def list_sampled_ns(frames: FrameBatch) -> list[list[int]]:
    """List the instants of every tile's readings."""
    return [
        [int(t) + 1000 * int(o) for t, o in zip(frames.t_mono_ns, offsets, strict=True)]
        for offsets in frames.sample_offset_us.T
    ]


def list_effects(plan: EstimationPlan) -> list[Any]:
    """List the effects of every dome."""
    return [plan.calibration.get_tile_or_wildcard(plan.info.tiles[i].serial).effects for i in DOMES]


def compute_sample_stage(plan: EstimationPlan, frames: FrameBatch, run: list[int]) -> Any:
    """Compute gauge pressures of all tiles, and apparent forces of every dome, over frames."""
    n = len(frames)
    tare = plan.tare
    base = [mpf(float(p)) for p in tare.baseline_kpa]
    noise = [mpf(float(p)) for p in tare.noise_kpa]
    t_ns, frame_ns = list_sampled_ns(frames), [int(t) for t in frames.t_mono_ns]
    temperature_raw, kpa = [], []
    for i in range(4):
        counts = [None if c == NOT_READ else int(c) for c in frames.temperature_raw[:, i]]
        last = [next(c for c in reversed(counts[: k + 1]) if c is not None) for k in range(n)]
        words = plan.info.tiles[i].registers
        temperature_raw.append(last)
        kpa.append(
            [
                None if status else sample_stage.pressure_kpa(words, int(p), c)
                for p, c, status in zip(
                    frames.pressure_raw[:, i], last, frames.tile_flags[:, i], strict=True
                )
            ]
        )
    for i in range(4):
        kpa[i] = [
            _replace_spike(kpa[i], k, run, mpf(OUTLIER_SIGMAS) * mp.sqrt(mpf(1.5)) * noise[i])
            for k in range(n)
        ]
    gauge: list[list[Exact]] = [
        [None if p is None else p - base[i] for p in kpa[i]] for i in range(4)
    ]
    around = sample_stage.smoothed(gauge[3], frame_ns)
    effects = list_effects(plan)
    walls = [e.temperature.wall_per_kpa for e in effects]
    doubt = max(mpf(w.sigma) / mpf(w.value) for w in walls)
    domes = []
    for i in DOMES:
        warm = effects[i].temperature
        counts = [mpf(c) for c in temperature_raw[i]]
        of_gas, rise = sample_stage.temperature(counts, t_ns[i], mpf(warm.lag_s.value))
        kpa_per_count = mpf(warm.kpa_per_k.value) / mpf(-5.35)
        lag_ns = mpf(warm.lag_s.value) * 10**9
        away = counts[0] - mpf(float(tare.temperature_raw_counts[i]))
        away = away if abs(away) > 2 else mpf(0)
        wall = mpf(walls[i].value)
        passed = wall * base[i] / (1 + wall * base[i])
        dry: list[Exact] = []
        variance = []
        for k in range(n):
            warmed = kpa_per_count * (of_gas[k] - mpf(float(tare.temperature_raw_counts[i])))
            p, head = kpa[i][k], passed * around[k]
            dry.append(None if p is None else p / (1 + warmed / base[i]) - head)
            variance.append(
                mpf(float(tare.baseline_sigma_kpa[i])) ** 2
                + (mpf(warm.kpa_per_k.sigma) / mpf(warm.kpa_per_k.value) * warmed) ** 2
                + (mpf(warm.lag_s.sigma) * kpa_per_count * rise[k]) ** 2
                + (doubt * head) ** 2
                + (kpa_per_count * away * mp.exp(-mpf(t_ns[i][k] - t_ns[i][0]) / lag_ns)) ** 2
            )
        gauge[i] = [None if p is None else p - base[i] for p in dry]
        hot = effects[i].gas
        entry = plan.calibration.get_tile_or_wildcard(plan.info.tiles[i].serial)
        # A reading beyond the chip's end is a guess between the least and the most.
        high = mpf(entry.range_kpa[1])
        end = max(mpf(115), base[i] + high)
        hidden = [p is not None and p > end for p in kpa[i]]
        heats = mpf(hot.gamma.value), mpf(hot.tau_s.value), wall, base[i]
        end_n, end_slope, _ = _compute_settled_force(entry, high)
        most_n = 2 * (end_n + end_slope * (end - base[i] - high))
        most_hot, end_hot = (
            base[i] * (1 + gauge / base[i]) ** mpf(hot.gamma.value)
            for gauge in (high + (most_n - end_n) / end_slope, high)
        )
        least = [dry[k] - (kpa[i][k] - end) if hidden[k] else None for k in range(n)]
        taken = [min(p, most_hot) if h else p for p, h in zip(dry, hidden, strict=True)]
        other = [
            _select_farthest(p, low, most_hot) if low is not None else p
            for p, low in zip(taken, least, strict=True)
        ]
        guess = sample_stage.gas(taken, t_ns[i], *heats)
        elsewise = sample_stage.gas(other, t_ns[i], *heats, end_hot)
        settled = list(guess)
        part = (mpf(hot.gamma.value) - 1) / mpf(hot.gamma.value)
        for k in range(n):
            if hidden[k]:
                settled[k] = least[k] * (base[i] / least[k]) ** part
        apparent: list[Exact] = []
        single: list[Exact] = []
        beyond: list[bool] = []
        own: list[Exact] = []
        heat_n: list[Exact] = [None] * n
        unseen_heat_n: list[Exact] = [None] * n
        guess_n: list[Exact] = [None] * n
        for k in range(n):
            p = settled[k]
            if p is None:
                apparent.append(None)
                single.append(None)
                beyond.append(False)
                own.append(None)
                continue
            force, slope, fit = _compute_settled_force(entry, p - base[i])
            apparent.append(force)
            single.append(abs(slope) * noise[i])
            beyond.append(p - base[i] > high or hidden[k])
            if beyond[k]:
                above = max(guess[k] - base[i] - high, mpf(0))
                guess_n[k] = min(
                    _compute_settled_force(entry, guess[k] - base[i])[0] + end_slope * above, most_n
                )
            heat_n[k] = slope * mpf(hot.misfit) * (guess[k] - dry[k])
            unseen_heat_n[k] = 0 if hidden[k] else slope * (elsewise[k] - guess[k]) / mp.sqrt(3)
            own.append(slope**2 * variance[k] + fit)
        domes.append(
            SimpleNamespace(
                apparent=apparent, single=single, beyond=beyond, own=own, heat_n=heat_n,
                unseen_heat_n=unseen_heat_n, guess_n=guess_n, most_n=most_n, end_n=end_n,
            )
        )  # fmt: skip
    return gauge, domes


def compute_chain(plan: EstimationPlan, frames: FrameBatch, run: list[int]) -> Any:
    """Compute the full ladder: lists over tiles of lists over frames."""
    n, effects = len(frames), list_effects(plan)
    t_ns, frame_ns = list_sampled_ns(frames), [int(t) for t in frames.t_mono_ns]
    gauge, domes = compute_sample_stage(plan, frames, run)
    forces, stated, bounds, errors = [], [], [], []
    bends: list[list[Exact]] = []
    of_bends: list[list[Exact]] = []
    usable = [
        [None if b else f for f, b in zip(of.apparent, of.beyond, strict=True)] for of in domes
    ]

    def transpose(columns: list[list[Exact]]) -> list[Any]:
        """List values by frame; None where a tile has none."""
        return [None if None in row else list(row) for row in zip(*columns, strict=True)]

    sampled = [sum(row) // len(domes) for row in zip(*t_ns[: len(DOMES)], strict=True)]
    together: list[Any] = smoothing_stage.denoised(
        [None if row is None else mp.fsum(row) for row in transpose(usable)],
        [None if row is None else mp.norm(row) for row in transpose([of.single for of in domes])],
        sampled,
        frame_ns,
        frame_ns,
        run,
        plan.lag_ns - 1,
        plan.load_bearing_params["variance_inflation"].mean(axis=0),
    )
    within = [None if each is None else each[4] for each in together]
    for i in DOMES:
        of, curve = domes[i], effects[i].rubber
        apparent, single, beyond, own = of.apparent, of.single, of.beyond, of.own
        heat_n, unseen_heat_n, guess_n = of.heat_n, of.unseen_heat_n, of.guess_n
        most_n, end_n = of.most_n, of.end_n
        averaged: list[Any] = smoothing_stage.denoised(
            usable[i],
            single,
            t_ns[i],
            frame_ns,
            frame_ns,
            run,
            plan.lag_ns - 1,
            plan.load_bearing_params["variance_inflation"][i],
            within,
        )
        smooth = [f if a is None else a[0] for f, a in zip(apparent, averaged, strict=True)]
        loop = [mpf(w.value) for w in effects[i].hysteresis.part]
        parts, taus_s = ([mpf(p.value) for p in x] for x in (curve.part, curve.tau_s))
        flows = effects[i].hysteresis.flow
        branch = mpf(flows.part.value), mpf(flows.stress_n.value), mpf(flows.power.value)
        sprung = smoothing_stage.flow(smooth, frame_ns, *branch, guess_n)
        unlooped = smoothing_stage.hysteresis(sprung, loop, guess_n)
        force_n = smoothing_stage.rubber(unlooped, frame_ns, parts, taus_s, guess_n)
        loads = [
            None if g is None else _select_farthest(g, f, most_n)
            for f, g in zip(apparent, guess_n, strict=True)
        ]
        sprung = smoothing_stage.flow(smooth, frame_ns, *branch, loads, end_n)
        unlooped = smoothing_stage.hysteresis(sprung, loop, loads)
        else_n = smoothing_stage.rubber(unlooped, frame_ns, parts, taus_s, loads, end_n)
        unseen_creep_n: list[Exact] = [
            None if f is None else 0 if b else (other_n - f) / mp.sqrt(3)
            for f, other_n, b in zip(force_n, else_n, beyond, strict=True)
        ]
        rubber_n: list[Exact] = [
            None
            if f is None
            else mpf(curve.misfit) * (min(f, g) if b else f) - mpf(curve.misfit) * s
            for f, g, b, s in zip(force_n, else_n, beyond, smooth, strict=True)
        ]
        own_n: list[Exact] = [None] * n
        stated_n = list(force_n)
        for k in range(n):
            if force_n[k] is None:
                continue
            left = mpf(1) if beyond[k] else averaged[k][1]
            own_n[k] = mp.sqrt(single[k] ** 2 * left + own[k])
            if beyond[k]:
                common = [
                    each[k] ** 2 for each in (heat_n, rubber_n, unseen_heat_n, unseen_creep_n)
                ]
                sigma = mp.sqrt(own_n[k] ** 2 + mp.fsum(common))
                force_n[k] = min(force_n[k], else_n[k])
                stated_n[k] = force_n[k] - mpf(BOUND_SIGMAS) * sigma
        forces.append(force_n)
        stated.append(stated_n)
        bounds.append(beyond)
        errors.append([own_n, heat_n, rubber_n, unseen_heat_n, unseen_creep_n])
        bends.append([None if a is None else a[2] for a in averaged])
        of_bends.append(
            [
                None if a is None else s * mp.sqrt(a[3])
                for a, s in zip(averaged, single, strict=True)
            ]
        )
    for of_tile, bend_n in zip(errors, smoothing_stage.shared_bend(bends, of_bends), strict=True):
        of_tile.append(bend_n)
    return SimpleNamespace(
        gauge_kpa=gauge, force_n=forces, stated_n=stated, is_bound=bounds, errors=errors
    )


def compute_sigma(errors: list[Any], k: int, weights: list[Exact]) -> Exact:
    """Compute sigma of a weighted sum, in which only own errors of tiles are independent."""
    own = mp.fsum((w * e[0][k]) ** 2 for w, e in zip(weights, errors, strict=True))
    shared = [mp.fdot(weights, [e[part][k] for e in errors]) for part in (1, 2, 3, 4, 5)]
    return mp.sqrt(own + mp.fsum(each**2 for each in shared))


def _select_farthest(of: Exact, *values: Exact) -> Exact:
    return max(values, key=lambda value: abs(value - of))


def _replace_spike(kpa: list[Exact], k: int, run: list[int], far: Exact) -> Exact:
    whole = 0 < k < len(kpa) - 1 and run[k - 1] == run[k] == run[k + 1]
    if not whole or None in kpa[k - 1 : k + 2]:
        return kpa[k]
    mean = (kpa[k - 1] + kpa[k + 1]) / 2
    off = abs(kpa[k] - mean)
    return mean if off > far and abs(kpa[k + 1] - kpa[k - 1]) < off else kpa[k]


def _compute_settled_force(entry: TileCalibration, gauge: Exact) -> tuple[Exact, Exact, Exact]:
    """Compute force, slope and variance of the settled curve."""
    curve = entry.effects.rubber
    assert curve is not None
    settled = {"coefficients": curve.coefficients, "covariance": curve.covariance}
    force, slope, variance = sample_stage.static(entry.model_copy(update=settled), gauge)
    variance += (mpf(curve.curve_misfit_n) * abs(force) / (abs(force) + mpf(0.2))) ** 2
    inside = min(max(gauge, mpf(0)), mpf(entry.range_kpa[1]))
    variance += (mpf(curve.scatter) * slope * inside) ** 2
    return force, slope, variance
