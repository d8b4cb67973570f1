"""The full ladder, from counts to GRF and centre of pressure, against fifty digits all the way.

Three domes and a bare tile, 70 frames in which everything happens: a step, a spike, a gap of a
minute, a silent tile, a saturated one, warmth, water. Windows are chosen by the reference itself.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpmath import mp, mpf

from devices.frames import NOT_READ, FrameBatch, TileStatus
from service.estimation.calibration import TileCalibration
from service.estimation.effects import FlowEffect, Parameter
from service.estimation.estimates import EstimateStatus
from service.estimation.ladder.chosen import MODELS
from service.estimation.ladder.plan import EstimationPlan, make_plan
from service.estimation.ladder.upper import BOUND_SIGMAS
from service.estimation.models.outliers import FAR
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP, array_at
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate
from tests.builders.frames import loaded_frames
from tests.service.estimation.exact import equations

PARTS = [DATA_SHEET_CHIP, FORUM_CHIP] * 2
UNLOADED_COUNTS = (380, 287, 369, 302)
POSITIONS_M = [(-0.02, 0.011, -0.15), (0.0, -0.007, -0.15), (0.02, 0.01, -0.15), (0.1, 0.0, -0.1)]
LAG_MS = 10.0
ROWS = 70

Exact = Any


def chain(plan: EstimationPlan, frames: FrameBatch, run: list[int]) -> Any:
    """Everything at fifty digits: lists over tiles of lists over frames."""
    n, domes = len(frames), range(3)
    tare = plan.tare
    base = [mpf(float(p)) for p in tare.baseline_kpa]
    noise = [mpf(float(p)) for p in tare.noise_kpa]
    t_ns = [
        [int(t) + 1000 * int(o) for t, o in zip(frames.t_mono_ns, offsets, strict=True)]
        for offsets in frames.sample_offset_us.T
    ]
    frame_ns = [int(t) for t in frames.t_mono_ns]
    tadc, kpa = [], []
    for i in range(4):
        counts = [None if c == NOT_READ else int(c) for c in frames.tadc[:, i]]
        held = [next(c for c in reversed(counts[: k + 1]) if c is not None) for k in range(n)]
        words = plan.info.tiles[i].coefficient_words
        tadc.append(held)
        kpa.append(
            [
                None if status else equations.pressure_kpa(words, int(p), c)
                for p, c, status in zip(frames.padc[:, i], held, frames.status[:, i], strict=True)
            ]
        )
    for i in range(4):
        kpa[i] = [
            _without_spike(kpa[i], k, run, mpf(FAR) * mp.sqrt(mpf(1.5)) * noise[i])
            for k in range(n)
        ]
    gauge: list[list[Exact]] = [
        [None if p is None else p - base[i] for p in kpa[i]] for i in range(4)
    ]
    around = equations.smoothed(gauge[3], frame_ns)
    effects: list[Any] = [plan.calibration.of(plan.info.tiles[i].serial).effects for i in domes]
    walls = [e.temperature.wall_per_kpa for e in effects]
    doubt = max(mpf(w.sigma) / mpf(w.value) for w in walls)
    forces, stated, bounds, errors, felt = [], [], [], [], []
    bends: list[list[Exact]] = []
    of_bends: list[list[Exact]] = []
    for i in domes:
        warm, curve = effects[i].temperature, effects[i].rubber
        counts = [mpf(c) for c in tadc[i]]
        of_gas, rise = equations.temperature(counts, t_ns[i], mpf(warm.lag_s.value))
        kpa_per_count = mpf(warm.kpa_per_k.value) / mpf(-5.35)
        lag_ns = mpf(warm.lag_s.value) * 10**9
        away = counts[0] - mpf(float(tare.tadc_counts[i]))
        away = away if abs(away) > 2 else mpf(0)
        wall = mpf(walls[i].value)
        passed = wall * base[i] / (1 + wall * base[i])
        dry: list[Exact] = []
        variance = []
        for k in range(n):
            warmed = kpa_per_count * (of_gas[k] - mpf(float(tare.tadc_counts[i])))
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
        entry = plan.calibration.of(plan.info.tiles[i].serial)
        # What was read beyond the chip's end is a guess; the least and the most may have been.
        high = mpf(entry.range_kpa[1])
        end = max(mpf(115), base[i] + high)
        hidden = [p is not None and p > end for p in kpa[i]]
        heats = mpf(hot.gamma.value), mpf(hot.tau_s.value), wall, base[i]
        end_n, end_slope, _ = _static(entry, high)
        most_n = 2 * (end_n + end_slope * (end - base[i] - high))
        most_hot, end_hot = (
            base[i] * (1 + gauge / base[i]) ** mpf(hot.gamma.value)
            for gauge in (high + (most_n - end_n) / end_slope, high)
        )
        least = [dry[k] - (kpa[i][k] - end) if hidden[k] else None for k in range(n)]
        taken = [min(p, most_hot) if h else p for p, h in zip(dry, hidden, strict=True)]
        other = [
            _farthest(p, low, most_hot) if low is not None else p
            for p, low in zip(taken, least, strict=True)
        ]
        guess = equations.gas(taken, t_ns[i], *heats)
        elsewise = equations.gas(other, t_ns[i], *heats, end_hot)
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
            force, slope, fit = _static(entry, p - base[i])
            apparent.append(force)
            single.append(abs(slope) * noise[i])
            beyond.append(p - base[i] > high or hidden[k])
            if beyond[k]:
                above = max(guess[k] - base[i] - high, mpf(0))
                guess_n[k] = min(_static(entry, guess[k] - base[i])[0] + end_slope * above, most_n)
            heat_n[k] = slope * mpf(hot.misfit) * (guess[k] - dry[k])
            unseen_heat_n[k] = 0 if hidden[k] else slope * (elsewise[k] - guess[k]) / mp.sqrt(3)
            own.append(slope**2 * variance[k] + fit)
        felt.append(
            SimpleNamespace(
                apparent=apparent, single=single, beyond=beyond, own=own, heat_n=heat_n,
                unseen_heat_n=unseen_heat_n, guess_n=guess_n, most_n=most_n, end_n=end_n,
            )
        )  # fmt: skip
    usable = [
        [None if b else f for f, b in zip(of.apparent, of.beyond, strict=True)] for of in felt
    ]

    def of_all(columns: list[list[Exact]]) -> list[Any]:
        """By frame; None where a tile has none."""
        return [None if None in row else list(row) for row in zip(*columns, strict=True)]

    sampled = [sum(row) // len(felt) for row in zip(*t_ns[:3], strict=True)]
    together: list[Any] = equations.denoised(
        [None if row is None else mp.fsum(row) for row in of_all(usable)],
        [None if row is None else mp.norm(row) for row in of_all([of.single for of in felt])],
        sampled,
        frame_ns,
        frame_ns,
        run,
        plan.lag_ns - 1,
        plan.noise_left.mean(axis=0),
    )
    within = [None if each is None else each[4] for each in together]
    for i in domes:
        of, curve = felt[i], effects[i].rubber
        apparent, single, beyond, own = of.apparent, of.single, of.beyond, of.own
        heat_n, unseen_heat_n, guess_n = of.heat_n, of.unseen_heat_n, of.guess_n
        most_n, end_n = of.most_n, of.end_n
        averaged: list[Any] = equations.denoised(
            usable[i],
            single,
            t_ns[i],
            frame_ns,
            frame_ns,
            run,
            plan.lag_ns - 1,
            plan.noise_left[i],
            within,
        )
        smooth = [f if a is None else a[0] for f, a in zip(apparent, averaged, strict=True)]
        loop = [mpf(w.value) for w in effects[i].hysteresis.part]
        parts, taus_s = ([mpf(p.value) for p in x] for x in (curve.part, curve.tau_s))
        flows = effects[i].hysteresis.flow
        branch = mpf(flows.part.value), mpf(flows.stress_n.value), mpf(flows.power.value)
        sprung = equations.flow(smooth, frame_ns, *branch, guess_n)
        unlooped = equations.hysteresis(sprung, loop, guess_n)
        force_n = equations.rubber(unlooped, frame_ns, parts, taus_s, guess_n)
        borne = [
            None if g is None else _farthest(g, f, most_n)
            for f, g in zip(apparent, guess_n, strict=True)
        ]
        sprung = equations.flow(smooth, frame_ns, *branch, borne, end_n)
        unlooped = equations.hysteresis(sprung, loop, borne)
        else_n = equations.rubber(unlooped, frame_ns, parts, taus_s, borne, end_n)
        crept_n: list[Exact] = [
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
                common = [each[k] ** 2 for each in (heat_n, rubber_n, unseen_heat_n, crept_n)]
                sigma = mp.sqrt(own_n[k] ** 2 + mp.fsum(common))
                force_n[k] = min(force_n[k], else_n[k])
                stated_n[k] = force_n[k] - mpf(BOUND_SIGMAS) * sigma
        forces.append(force_n)
        stated.append(stated_n)
        bounds.append(beyond)
        errors.append([own_n, heat_n, rubber_n, unseen_heat_n, crept_n])
        bends.append([None if a is None else a[2] for a in averaged])
        of_bends.append(
            [
                None if a is None else s * mp.sqrt(a[3])
                for a, s in zip(averaged, single, strict=True)
            ]
        )
    for of_tile, bend_n in zip(errors, equations.shared_bend(bends, of_bends), strict=True):
        of_tile.append(bend_n)
    return SimpleNamespace(
        gauge_kpa=gauge, force_n=forces, stated_n=stated, is_bound=bounds, errors=errors
    )


def sigma_of(errors: list[Any], k: int, weights: list[Exact]) -> Exact:
    """Of a weighted sum over tiles: what is a tile's own adds as squares, the rest as is."""
    own = mp.fsum((w * e[0][k]) ** 2 for w, e in zip(weights, errors, strict=True))
    shared = [mp.fdot(weights, [e[part][k] for e in errors]) for part in (1, 2, 3, 4, 5)]
    return mp.sqrt(own + mp.fsum(each**2 for each in shared))


def _farthest(of: Exact, *values: Exact) -> Exact:
    return max(values, key=lambda value: abs(value - of))


def _without_spike(kpa: list[Exact], k: int, run: list[int], far: Exact) -> Exact:
    whole = 0 < k < len(kpa) - 1 and run[k - 1] == run[k] == run[k + 1]
    if not whole or None in kpa[k - 1 : k + 2]:
        return kpa[k]
    mean = (kpa[k - 1] + kpa[k + 1]) / 2
    off = abs(kpa[k] - mean)
    return mean if off > far and abs(kpa[k + 1] - kpa[k - 1]) < off else kpa[k]


def _static(entry: TileCalibration, gauge: Exact) -> tuple[Exact, Exact, Exact]:
    """Force, slope and variance of the curve of forces that have lasted."""
    curve = entry.effects.rubber
    assert curve is not None
    c = [mpf(x) for x in curve.coefficients]
    offset, scale, gain = mpf(entry.p_offset_kpa), mpf(entry.p_scale_kpa), mpf(entry.f_scale_n)
    inside = min(max(gauge, mpf(0)), mpf(entry.range_kpa[1]))
    u, u0 = (inside - offset) / scale, -offset / scale

    def slope_at(u: Exact) -> Exact:
        return gain * (c[1] + 2 * c[2] * u + 3 * c[3] * u**2) / scale

    basis = [gain * (u**k - u0**k) for k in (1, 2, 3)]
    force = mp.fdot(c[1:], basis) + min(gauge, mpf(0)) * slope_at(u0)
    variance = sum(
        mpf(curve.covariance[i][j]) * basis[i] * basis[j] for i in range(3) for j in range(3)
    )
    variance += (mpf(curve.curve_misfit_n) * abs(force) / (abs(force) + mpf(0.2))) ** 2
    variance += (mpf(curve.scatter) * slope_at(u) * inside) ** 2
    return force, slope_at(u), variance


@pytest.fixture(scope="module")
def plan() -> EstimationPlan:
    """Every dome with effects of its own; nothing is a round number."""
    info = array_at(POSITIONS_M, references=[3], chips=PARTS)
    known = make_effects()
    assert known.gas is not None
    assert known.rubber is not None
    assert known.hysteresis is not None
    tiles = []
    for i in range(3):
        curve = (0.0, 13.25 + i, 1.0 / 3.0, 4.7 - 0.3 * i)
        tau_s = known.gas.tau_s.model_copy(update={"value": 0.0047 * (1 + i)})
        covariance = ((4e-3, 1e-3, -2e-3), (1e-3, 2e-3, 0.0), (-2e-3, 0.0, 3e-3))
        rubber = known.rubber.model_copy(update={"coefficients": curve, "covariance": covariance})
        gas = known.gas.model_copy(update={"tau_s": tau_s})
        flow = FlowEffect(
            part=Parameter(value=0.07 + 0.01 * i, sigma=0.01),
            stress_n=Parameter(value=0.11 * (1 + i), sigma=0.01),
            power=Parameter(value=3.3 + i, sigma=0.1),
        )
        loop = known.hysteresis.model_copy(update={"flow": flow})
        tiles.append(
            newton_tile(
                info.serials[i],
                coefficients=curve,
                p_offset_kpa=9.37,
                p_scale_kpa=9.37,
                range_kpa=(0.0, 18.74),
                effects=known.model_copy(update={"gas": gas, "rubber": rubber, "hysteresis": loop}),
            )
        )
    tare = make_tare(
        4,
        baseline_kpa=[100.30127, 99.87654321, 101.7, 98.0 + 1 / 3],
        baseline_sigma_kpa=[0.0071, 0.0073, 0.007, 0.0069],
        noise_kpa=[0.165, 0.171, 0.163, 0.168],
        tadc_counts=[507.3, 506.7, 507.0, 1522 / 3],
    )
    return make_plan(info, make_calibration(*tiles), tare, models=MODELS, lag_ms=LAG_MS)


def eventful(seed: int) -> tuple[FrameBatch, list[int]]:
    """The recording, and the number of the unbroken run that each frame is in."""
    rng = np.random.default_rng(seed)
    load = np.zeros((ROWS, 4))
    load[8:, :3] = [60, 45, 70]
    load[30:, :3] += 12 * np.sin(np.arange(ROWS - 30) / 5.0)[:, None]
    load[52:, :3] *= 0.2
    load += rng.normal(0, 1.3, load.shape)
    load[20, 1] -= 14.0
    load[44:46, 2] = 200.0
    load[:, 3] = np.linspace(0, 6, ROWS)
    padc = np.array(UNLOADED_COUNTS) - np.rint(load).astype(int)
    tadc = 507 - np.arange(ROWS)[:, None] // 9 + rng.integers(0, 2, padc.shape)
    status = np.zeros(padc.shape, dtype=int)
    padc[25, 0], tadc[25, 0], status[25, 0] = NOT_READ, NOT_READ, TileStatus.NO_ANSWER
    steps_ns = np.full(ROWS, 1_838_235)
    steps_ns[38] = 60 * 10**9
    frames = loaded_frames(
        np.zeros(padc.shape),
        padc=padc,
        tadc=tadc,
        status=status,
        t_mono_ns=np.cumsum(steps_ns),
        sample_offset_us=np.tile([0, 431, 862, 1293], (ROWS, 1)),
    )
    return frames, [int(row >= 38) for row in range(ROWS)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_full_ladder_is_within_a_nanonewton(plan: EstimationPlan, seed: int) -> None:
    frames, run = eventful(seed)
    e = estimate(plan, *(frames.rows(i, i + 11) for i in range(0, ROWS, 11)))
    exact = chain(plan, frames, run)
    for i in range(4):
        assert equations.apart(e.gauge_kpa[:, i], exact.gauge_kpa[i]) < 1e-10
    one = [mpf(1)]
    for i in range(3):
        assert equations.apart(e.force_n[:, i], exact.stated_n[i]) < 1e-9
        sigma_n = [
            None if f is None or b else sigma_of(exact.errors[i : i + 1], k, one)
            for k, (f, b) in enumerate(zip(exact.force_n[i], exact.is_bound[i], strict=True))
        ]
        assert equations.apart(e.force_sigma_n[:, i], sigma_n) < 1e-9
    by_frame = list(zip(*exact.force_n, strict=True))
    bound = [any(row) for row in zip(*exact.is_bound, strict=True)]
    grf = [None if None in row or b else sum(row) for row, b in zip(by_frame, bound, strict=True)]
    assert equations.apart(e.grf_n, grf) < 1e-9
    sigma_n = [None if f is None else sigma_of(exact.errors, k, 3 * one) for k, f in enumerate(grf)]
    assert equations.apart(e.grf_sigma_n, sigma_n) < 1e-9
    least = []
    for k, row in enumerate(by_frame):
        known = [i for i, force in enumerate(row) if force is not None]
        total = mp.fsum(row[i] for i in known)
        doubt = sigma_of([exact.errors[i] for i in known], k, one * len(known))
        least.append(total - mpf(BOUND_SIGMAS) * doubt)
    assert equations.apart(e.grf_at_least_n, least) < 1e-9
    assert None in grf
    stated = np.flatnonzero(np.isfinite(e.cop_x_m)).tolist()
    assert len(stated) > 20
    for axis, name in enumerate(("x", "y")):
        places = [mpf(position[axis]) for position in POSITIONS_M[:3]]
        centre = [mp.fdot(by_frame[k], places) / grf[k] for k in stated]
        assert equations.apart(getattr(e, f"cop_{name}_m")[stated], centre) < 1e-11
        sigma_m = [
            sigma_of(exact.errors, k, [(place - at) / grf[k] for place in places])
            for k, at in zip(stated, centre, strict=True)
        ]
        assert equations.apart(getattr(e, f"cop_sigma_{name}_m")[stated], sigma_m) < 1e-11
    flags = EstimateStatus.OUTLIER_REPLACED, EstimateStatus.GAP, EstimateStatus.SATURATED
    for flag in (*flags, EstimateStatus.TILE_MISSING, EstimateStatus.AFTER_SATURATION):
        assert (e.estimate_status & flag).any(), flag
