"""The sample stage at fifty digits: pressure, gas, temperature, ambient and static curve.

Written from the docstrings of the models and the design, not from the code.
"""

from __future__ import annotations

from mpmath import mp, mpf

from service.estimation.calibration import TileCalibration
from service.estimation.models import ambient
from service.estimation.models import temperature as temperature_model
from tests.service.estimation.exact.digits import Exact

AWAY_NS = 50_000_000
"""Time without a reading after which any load may have passed."""


def pressure_kpa(words: tuple[int, ...], pressure_raw: int, temperature_raw: int) -> Exact:
    """Compute data sheet 8.1 and 8.2; counts below 50 kPa have fallen through zero.

    None if it is below the chip's range even so: then it is no pressure.
    """
    a0, b1, b2, c12 = (word - 65536 if word >= 32768 else word for word in words)

    def kpa(counts: int) -> Exact:
        slope = mpf(b1) / 2**13 + mpf(c12 >> 2) / 2**22 * temperature_raw
        pcomp = mpf(a0) / 2**3 + slope * counts + mpf(b2) / 2**14 * temperature_raw
        return pcomp * mpf(115 - 50) / 1023 + 50

    pressure = kpa(pressure_raw) if kpa(pressure_raw) >= 50 else kpa(pressure_raw - 1024)
    return pressure if pressure >= 50 else None


def gas(
    kpa: list[Exact],
    t_ns: list[int],
    gamma: Exact,
    tau_s: Exact,
    c: Exact,
    p0: Exact,
    away: Exact = None,
) -> list[Exact]:
    """`gamma dT/dt = (gamma - 1) T d(ln p)/dt - (T - 1)/tau`, ln p linear, by its own integral.

    With `away` the gas had cooled at that pressure or at p0, the farther one, while nothing was
    read, and went to its present one without losing heat.
    """
    k = (gamma - 1) / gamma
    out: list[Exact] = []
    temperature, before, before_ns = mpf(1), None, 0
    for p, now_ns in zip(kpa, t_ns, strict=True):
        if p is None:
            out.append(None)
            continue
        h = mpf(now_ns - before_ns) / 10**9 / (gamma * tau_s)
        if before is None or not 0 <= h <= 5:
            temperature = mpf(1)
        else:
            # Over s from 0 to h: T' = -T x/h + 1 with x = h - k ln(p/before), so that
            # T(h) = exp(-x) T(0) + (integral of exp(-x s/h) over s).
            x = h - k * mp.log(p / before)
            warming = h * (1 - mp.exp(-x)) / x if x != 0 else h
            temperature = mp.exp(-x) * temperature + warming
        if away is not None and before is not None and now_ns - before_ns > AWAY_NS:
            temperature = (p / max((away, p0), key=lambda q: abs(mp.log(p / q)))) ** k
        before, before_ns = p, now_ns
        iso = p / temperature
        out.append(iso * (1 + c * (p - p0)) / (1 + c * (iso - p0)))
    return out


def temperature(
    counts: list[Exact], t_ns: list[int], lag_s: Exact
) -> tuple[list[Exact], list[Exact]]:
    """Compute counts of the gas, and their rise in counts a second.

    `S x' = chip - x` with the chip linear between readings, and `S y' = x - y` with x as linear;
    for half a second plain means. The gas is x of the time S = lag, where that is 0.1 s or more;
    below, and ahead of the chip, it goes on by the rise.
    """
    out: list[Exact] = []
    rises: list[Exact] = []
    least = mpf(temperature_model.SMOOTHING_MIN_S)
    behind = lag_s if lag_s >= 0 else -lag_s * mpf(temperature_model.SMOOTHING_PER_LAG)
    smooth = max(behind, least)
    x = y = before = None
    first_ns = last_ns = 0
    for value, at_ns in zip(counts, t_ns, strict=True):
        if value is not None:
            if x is None:
                x = y = value
                first_ns = at_ns
            else:
                passed = max(mpf(0), mpf(at_ns - last_ns) / 10**9)
                known = mpf(at_ns - first_ns) / 10**9
                time = smooth if known > mpf("0.5") else min(smooth, max(passed, known))
                if passed > 0:
                    h = passed / time
                    decay, mean = mp.exp(-h), (1 - mp.exp(-h)) / h
                    old = x
                    x = decay * x + (mean - decay) * before + (1 - mean) * value
                    y = decay * y + (mean - decay) * old + (1 - mean) * x
            before, last_ns = value, at_ns
        if x is None:
            out.append(None)
            rises.append(None)
            continue
        rise = ((before - x) if lag_s >= 0 else (x - y)) / smooth
        out.append(x + (smooth - lag_s) * rise)
        rises.append(rise)
    return out, rises


def smoothed(kpa: list[Exact], t_ns: list[int]) -> list[Exact]:
    """Compute a low-pass of 30 ms, which stays for a while without a reading."""
    out: list[Exact] = []
    value, last_ns = None, 0
    for p, now_ns in zip(kpa, t_ns, strict=True):
        if p is not None:
            if value is None:
                value = p
            else:
                passed = max(mpf(0), mpf(now_ns - last_ns) / 10**9)
                value += (1 - mp.exp(-passed / (mpf(3) / 100))) * (p - value)
            last_ns = now_ns
        is_recent = now_ns - last_ns <= ambient.HELD_S * 1e9
        out.append(value if is_recent else None)
    return out


def static(entry: TileCalibration, gauge: Exact) -> tuple[Exact, Exact, Exact]:
    """Compute force above zero pressure, slope and the variance of the static curve."""
    c = [mpf(x) for x in entry.coefficients]
    offset, scale, gain = mpf(entry.p_offset_kpa), mpf(entry.p_scale_kpa), mpf(entry.f_scale_n)
    inside = min(max(gauge, mpf(0)), mpf(entry.range_kpa[1]))
    u, u0 = (inside - offset) / scale, -offset / scale

    def slope_at(u: Exact) -> Exact:
        return gain * (c[1] + 2 * c[2] * u + 3 * c[3] * u**2) / scale

    basis = [gain * (u**k - u0**k) for k in (1, 2, 3)]
    force = mp.fdot(c[1:], basis) + min(gauge, mpf(0)) * slope_at(u0)
    covariance = mp.matrix([[mpf(x) for x in row] for row in entry.covariance])
    variance = (mp.matrix([basis]) * covariance * mp.matrix(basis))[0]
    return force, slope_at(u), variance
