"""The arithmetic of `static` by hand: numpy with buffers made once, one row per tile.

It computes all that the estimate of an instant consists of: compensation, gauge pressure, force,
slope, the calibration's and the reading's uncertainty, GRF, COP along three axes with sigma, the
grid index, and every flag; and it decides contact by its two thresholds and masks the COP. What it
does not have is everything around that: look-ahead, the minimum time of contact, gaps, held
temperatures, any number of rows.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from devices.chips.mpl115a2 import COUNTS_MAX, PRESSURE_MAX_KPA, PRESSURE_MIN_KPA, Coefficients
from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch
from service.estimation.calibration import CUBIC_TERMS, LOOP_HALF_WIDTH_FORCE_N
from service.estimation.pipeline.grf_cop import HULL_SIGMAS
from service.estimation.pipeline.plan import SIGNIFICANCE_SIGMAS, TARE_OLD_NS, EstimationPlan


def _column(values: object) -> Floats:
    return np.array(values, dtype=np.float64)[:, None]


class StaticKernel:
    """Forces, GRF and COP of up to `rows` frames at a time, in arrays that it keeps."""

    def __init__(self, plan: EstimationPlan, rows: int) -> None:
        tiles = plan.info.tiles
        n = len(tiles)
        chips = [Coefficients.from_words(tile.registers) for tile in tiles]
        scale = (PRESSURE_MAX_KPA - PRESSURE_MIN_KPA) / COUNTS_MAX
        # The conversion to kPa and the baseline are in the coefficients already.
        self.a0, self.b1, self.b2, self.c12 = (
            scale * _column([getattr(chip, name) for chip in chips])
            for name in ("a0", "b1", "b2", "c12")
        )
        self.baseline_kpa = _column(plan.tare.baseline_kpa)
        self.a0 += PRESSURE_MIN_KPA
        entries = [plan.calibration.get_tile_or_wildcard(tile.serial) for tile in tiles]
        self.offset = _column([t.p_offset_kpa for t in entries])
        self.per_kpa = 1.0 / _column([t.p_scale_kpa for t in entries])
        self.high_kpa = _column([t.range_kpa[1] for t in entries])
        self.c1, self.c2, self.c3 = (
            _column([t.coefficients[k] * t.f_scale_n for t in entries]) for k in (1, 2, 3)
        )
        self.u0 = -self.offset * self.per_kpa
        self.slope_at_zero = _column(plan.curves["slope_at_zero_n_per_kpa"])
        self.misfit = _column([t.relative_misfit for t in entries])
        self.loop_n = _column([t.loop_misfit_n for t in entries])
        # The matrix is symmetric: six terms instead of nine.
        self.covariance = {
            (i, j): _column([t.covariance[i][j] * t.f_scale_n**2 * (2 - (i == j)) for t in entries])
            for i in range(CUBIC_TERMS)
            for j in range(i, CUBIC_TERMS)
        }
        self.still_kpa = _column(np.hypot(plan.tare.noise_kpa, plan.tare.baseline_sigma_kpa))
        self.low_kpa = (
            _column([t.range_kpa[0] for t in entries]) - SIGNIFICANCE_SIGMAS * self.still_kpa
        )
        self.plan, self.load_bearing_params, self.foot = (
            plan,
            plan.load_bearing_params,
            plan.params.foot,
        )
        self.f = [np.empty((n, rows)) for _ in range(9)]
        self.flag = [np.empty((n, rows), dtype=np.bool_) for _ in range(4)]
        self.row = [np.empty(rows) for _ in range(12)]
        self.rows_ok = [np.empty(rows, dtype=np.bool_) for _ in range(2)]
        self.status = np.empty(rows, dtype=np.uint16)

    def __call__(self, frames: FrameBatch) -> dict[str, Floats]:
        """What these frames say; views into buffers that the next call overwrites."""
        n = len(frames)
        kpa, gauge, u, d, curve, slope, variance, force, extra = (f[:, :n] for f in self.f)
        missing, other, saturated, spare = (f[:, :n] for f in self.flag)
        # Counts to gauge pressure
        np.copyto(kpa, frames.pressure_raw.T)
        np.copyto(u, frames.temperature_raw.T)
        np.multiply(u, self.c12, out=d)
        d += self.b1
        np.multiply(kpa, d, out=kpa)
        u *= self.b2
        kpa += u
        kpa += self.a0
        np.not_equal(frames.tile_flags.T & np.uint8(TileFlag.UNUSABLE), 0, out=missing)
        np.equal(frames.pressure_raw.T, NOT_READ, out=other)
        missing |= other
        np.equal(frames.temperature_raw.T, NOT_READ, out=other)
        missing |= other
        np.less(kpa, PRESSURE_MIN_KPA, out=other)
        missing |= other
        np.subtract(kpa, self.baseline_kpa, out=gauge)
        np.copyto(gauge, np.nan, where=missing)
        # The cubic about u0, its slope, its uncertainty
        np.maximum(gauge, 0.0, out=u)
        np.minimum(u, self.high_kpa, out=u)
        u -= self.offset
        u *= self.per_kpa
        np.subtract(u, self.u0, out=d)
        np.multiply(u, u, out=extra)
        np.multiply(u, self.u0, out=force)
        force += extra
        force += self.u0 * self.u0
        force *= self.c3
        np.add(u, self.u0, out=curve)
        curve *= self.c2
        curve += force
        curve += self.c1
        curve *= d
        np.minimum(gauge, 0.0, out=force)
        force *= self.slope_at_zero
        force += curve
        np.multiply(u, 3.0 * self.c3, out=slope)
        slope += 2.0 * self.c2
        slope *= u
        slope += self.c1
        slope *= self.per_kpa
        extra -= self.u0 * self.u0  # second power
        np.multiply(u, u, out=curve)
        curve *= u
        curve -= self.u0**3  # third power
        basis = (d, extra, curve)
        variance.fill(0.0)
        for (i, j), covariance in self.covariance.items():
            np.multiply(basis[i], basis[j], out=u)
            u *= covariance
            variance += u
        np.maximum(variance, 0.0, out=variance)
        np.multiply(force, self.misfit, out=u)
        u *= u
        variance += u
        np.abs(force, out=u)
        np.add(u, LOOP_HALF_WIDTH_FORCE_N, out=d)
        np.divide(u, d, out=u)
        u *= self.loop_n
        u *= u
        variance += u
        slope *= self.still_kpa
        slope *= slope
        variance += slope
        np.greater(gauge, self.high_kpa, out=saturated)
        np.copyto(variance, np.nan, where=saturated)
        sigma = np.sqrt(variance, out=slope)
        # Sums over the tiles
        grf, grf_sigma, divisor, x, y, z, sx, sy, sz, beyond, nothing, index = (
            r[:n] for r in self.row
        )
        np.add.reduce(force, axis=0, out=grf)
        np.add.reduce(variance, axis=0, out=grf_sigma)
        np.sqrt(grf_sigma, out=grf_sigma)
        np.copyto(divisor, grf)
        np.copyto(divisor, np.nan, where=grf == 0.0)
        for axis, (at, at_sigma) in enumerate(((x, sx), (y, sy), (z, sz))):
            arm = self.load_bearing_params["position_m"][:, axis, None]
            np.multiply(force, arm, out=u)
            np.add.reduce(u, axis=0, out=at)
            np.divide(at, divisor, out=at)
            np.subtract(arm, at, out=u)
            u *= sigma
            u *= u
            np.add.reduce(u, axis=0, out=at_sigma)
            np.sqrt(at_sigma, out=at_sigma)
            np.abs(divisor, out=nothing)
            np.divide(at_sigma, nothing, out=at_sigma)
        if self.foot["has_grid"]:
            np.add.reduce(gauge, axis=0, out=nothing)
            for weights in self.load_bearing_params["grid_index"].T:
                np.multiply(gauge, weights[:, None], out=u)
                np.add.reduce(u, axis=0, out=index)
                index /= nothing
        # Flags, contact, and where a COP would be more doubtful than useful
        status, (good, also) = self.status[:n], (r[:n] for r in self.rows_ok)
        status.fill(0)
        np.less(gauge, self.low_kpa, out=other)
        np.greater(kpa, PRESSURE_MAX_KPA, out=spare)
        for bit, flagged in ((1, saturated), (2, other), (256, spare), (32, missing)):
            np.logical_or.reduce(flagged, axis=0, out=also)
            np.bitwise_or(status, np.uint16(bit), out=status, where=also)
        np.greater(frames.t_ns, self.plan.tare.t_ns + TARE_OLD_NS, out=also)
        np.bitwise_or(status, np.uint16(128), out=status, where=also)
        np.greater_equal(grf, self.foot["contact_on_n"], out=good)
        np.multiply(grf_sigma, SIGNIFICANCE_SIGMAS, out=nothing)
        np.greater_equal(grf, nothing, out=also)
        good &= also
        for at_sigma in (sx, sy):
            np.less_equal(at_sigma, self.foot["cop_sigma_max_m"], out=also)
            good &= also
        for nx, ny, offset_m in self.plan.params.hull:
            np.multiply(x, nx, out=beyond)
            np.multiply(y, ny, out=nothing)
            beyond += nothing
            beyond -= offset_m + 1e-9
            np.multiply(sx, nx, out=nothing)
            nothing *= nothing
            np.multiply(sy, ny, out=index)
            index *= index
            nothing += index
            np.sqrt(nothing, out=nothing)
            nothing *= HULL_SIGMAS
            np.less_equal(beyond, nothing, out=also)
            good &= also
        np.logical_not(good, out=also)
        for values in (x, y, sx, sy):
            np.copyto(values, np.nan, where=also)
        return {
            "force_n": force.T,
            "force_sigma_n": sigma.T,
            "grf_n": grf,
            "grf_sigma_n": grf_sigma,
            "cop_x_m": x,
            "cop_sigma_x_m": sx,
        }
