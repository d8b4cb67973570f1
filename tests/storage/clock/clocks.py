"""Clocks of nodes that drift and wander, and rows of measurements of them over a network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from devices.arrays import Times
from storage.clock.bounds import RATE_TOLERANCE, OffsetRows

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
BEGIN_NS = 77 * SECOND


@dataclass(frozen=True)
class Clock:
    """The true offset: rates in ppm between knots ten seconds apart, and steps."""

    rates_ppm: tuple[float, ...]
    offset_ns: int = 0
    steps: tuple[tuple[int, int], ...] = ()
    """Instants after `BEGIN_NS`, and by how many ns."""

    def at(self, t_mono_ns: Times) -> Times:
        x = (t_mono_ns - BEGIN_NS).astype(np.float64)
        knots = np.arange(len(self.rates_ppm) + 1) * 10.0 * SECOND
        rates = np.array(self.rates_ppm) * 1e-6
        values = np.concatenate(([0.0], np.cumsum(rates * 10.0 * SECOND)))
        k = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(rates) - 1)
        offset = self.offset_ns + np.rint(values[k] + rates[k] * (x - knots[k])).astype(np.int64)
        for after_ns, jump_ns in self.steps:
            offset += np.where(t_mono_ns - BEGIN_NS > after_ns, jump_ns, 0)
        return offset

    def measured(self, t_mono_ns: Times, seed: int, *, slow_ns: float = 3e6) -> OffsetRows:
        """Best of eight probes at each instant: ways back take three times as long as ways there.

        The server is read when the probe arrives; the row is about the middle of the round trip.
        """
        random = np.random.default_rng(seed)
        shape = (len(t_mono_ns), 8)
        go = np.rint(3e5 + random.exponential(slow_ns, shape)).astype(np.int64)
        back = np.rint(3e5 + random.exponential(3 * slow_ns, shape)).astype(np.int64)
        best = np.argmin(go + back, axis=1)
        rows = np.arange(len(t_mono_ns))
        go, back = go[rows, best], back[rows, best]
        sent, came = t_mono_ns, t_mono_ns + go + back
        middle = (sent + came) // 2
        server = sent + go + self.at(sent + go)
        return OffsetRows(middle, server - middle, (came - sent + 1) // 2)


def every(seconds: float, n: int) -> Times:
    return BEGIN_NS + np.arange(n, dtype=np.int64) * round(seconds * SECOND)


def rows_of(*rows: tuple[int, int, int]) -> OffsetRows:
    return OffsetRows(*np.array(rows, dtype=np.int64).T.copy())


def anywhere(rows: OffsetRows, seed: int, n: int = 500, beyond_ns: int = 0) -> Times:
    random = np.random.default_rng(seed + 1)
    begin, end = int(rows.t_mono_ns.min()), int(rows.t_mono_ns.max())
    drawn = random.integers(begin - beyond_ns, end + beyond_ns + 1, n)
    return np.concatenate((drawn, rows.t_mono_ns))


RATES = st.tuples(
    st.floats(-80, 80),
    st.floats(0, RATE_TOLERANCE * 1e6),
    st.integers(2, 40),
    st.integers(0, 2**32),
)


def wandering(drawn: tuple[float, float, int, int]) -> Clock:
    """Rates that wander about their mean, which is drawn."""
    mean, wander, n, seed = drawn
    rates = np.random.default_rng(seed).uniform(-1, 1, n)
    rates -= rates.mean()
    rates *= wander / max(np.abs(rates).max(), 1e-9)
    return Clock(tuple(mean + rates), offset_ns=seed * 1000 - HOUR)
