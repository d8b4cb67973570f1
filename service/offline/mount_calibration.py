"""Calibration of a mounted foot from a session on a force plate.

reference = zero + sum of gain F (1 + shear (1 - cos a)) + late dF/dt

by robust least squares, where F are our tile forces, `a` is the angle between a tile's axis and the
vertical, and `late` is the residual lag, which would otherwise bias the gains. Parameters that the
load does not determine are rejected: gains of tiles that are always loaded together, or the shear
of a foot whose tiles stay nearly upright.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from devices.arrays import Bools, Floats
from devices.errors import CalibrationError, FileFormatError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration, MountCalibration
from service.estimation.effects import Parameter
from service.estimation.foot import compute_tilt_loss, fit_tile_axis_angles_rad
from service.offline.calibration_lookup import read_calibration_of_session
from service.offline.compare.alignment import HUBER_SIGMAS
from service.offline.compare.block_covariance import (
    NORMAL_95,
    UncertainValue,
    compute_fit_uncertainty,
    compute_phase_covariance,
)
from service.offline.compare.paired_frames import PairedFrames
from service.offline.compare.plausibility import describe_implausible_alignment
from service.offline.compare.signals import compute_robust_deviation
from service.offline.comparison import ANGLE_COLUMN, CompareOptions, Comparison, compare_session
from storage.formats.reference import ReferenceOptions
from storage.sessions.reader import SealedFileReader

MAX_GAIN_SIGMA = 0.05
"""Largest standard uncertainty of a gain: a calibration rig reaches it without a plate."""
MAX_SHEAR_SIGMA = 0.3
"""Largest standard uncertainty of the shear: half of the 0.58 of a uniform prior from -1 to 1."""
MIN_RELATIVE_EIGENVALUE = 1e-10
"""Relative eigenvalue of the columns' correlation matrix below which columns are collinear."""
MIN_FRAMES = 200
"""Least number of loaded frames for phases and blocks."""
CROSS_VALIDATION_BLOCKS = 10
"""Number of time blocks for cross-validation."""

_LATE, _ZERO, _GAINS = 0, 1, 2


@dataclass(frozen=True)
class MountFit:
    """Result of a fit against a plate.

    Attributes:
        gains: gain of each tile; all equal if one common gain was fitted.
        shear: shear coefficient; None if it was not fitted.
        residual_lag_s: residual lag.
        mae_before_n: mean absolute GRF error under load before the fit, reference zero removed.
        mae_after_n: cross-validated mean absolute GRF error with gains and shear.
        frame_count: number of loaded frames.
        block_count: number of time blocks behind the uncertainties.
    """

    gains: tuple[Parameter, ...]
    shear: Parameter | None
    residual_lag_s: Parameter
    mae_before_n: float
    mae_after_n: float
    frame_count: int
    block_count: int


@dataclass(frozen=True)
class _LoadedFrames:
    """Loaded frames (n), and the index of the gain (g gains) of each tile."""

    reference_n: Floats
    force_n: Floats
    tilt_loss: Floats
    rate: Floats
    gain_of: npt.NDArray[np.intp]
    gains: int
    with_shear: bool

    def compute_reference_n(self, x: Floats) -> Floats:
        """Compute the modelled reference force, (n,)."""
        upright = 1.0 + (x[-1] if self.with_shear else 0.0) * self.tilt_loss
        gained = (self.force_n * upright) @ x[_GAINS + self.gain_of]
        return np.asarray(gained + x[_ZERO] + x[_LATE] * self.rate)

    def compute_residual_n(self, x: Floats) -> Floats:
        """Compute the residual of the reference, (n,)."""
        return np.asarray(self.reference_n - self.compute_reference_n(x))

    def compute_jacobian(self, x: Floats) -> Floats:
        """Compute the derivatives of `compute_residual_n`, (n, p)."""
        upright = 1.0 + (x[-1] if self.with_shear else 0.0) * self.tilt_loss
        columns = [self.rate, np.ones(len(self.rate))]
        for g in range(self.gains):
            columns.append((self.force_n * upright)[:, self.gain_of == g].sum(axis=1))
        if self.with_shear:
            columns.append((self.force_n * self.tilt_loss) @ x[_GAINS + self.gain_of])
        return -np.stack(columns, axis=1)

    def compute_grf_n(self, x: Floats) -> Floats:
        """Compute the GRF with gains and shear, (n,)."""
        return np.asarray(self.compute_reference_n(x) - x[_ZERO] - x[_LATE] * self.rate)

    def select(self, rows: Bools) -> _LoadedFrames:
        """Select frames."""
        return _LoadedFrames(
            self.reference_n[rows],
            self.force_n[rows],
            self.tilt_loss[rows],
            self.rate[rows],
            self.gain_of,
            self.gains,
            self.with_shear,
        )

    def fit(self) -> tuple[Floats, float]:
        """Fit the parameters (p,), late, zero, gains, shear; also return Huber's threshold in N."""
        x = np.concatenate([[0.0, 0.0], np.ones(self.gains), np.zeros(int(self.with_shear))])
        start = self.compute_jacobian(x)[:, : _GAINS + self.gains]
        x[: _GAINS + self.gains] = -np.linalg.lstsq(start, self.reference_n, rcond=None)[0]
        bend_n = HUBER_SIGMAS * self._estimate_noise_n(x)
        for _ in range(2):
            found = least_squares(
                self.compute_residual_n,
                x,
                self.compute_jacobian,
                loss="soft_l1",
                f_scale=bend_n,
                x_scale="jac",
            )
            x = found.x
            bend_n = HUBER_SIGMAS * self._estimate_noise_n(x)
        return x, bend_n

    def _estimate_noise_n(self, x: Floats) -> float:
        noise_n = compute_robust_deviation(self.compute_residual_n(x))
        return max(noise_n, 1e-6 * float(np.ptp(self.reference_n)))


def fit_mount(
    pairs: PairedFrames,
    force_n: Floats,
    tilt_loss: Floats,
    serials: Sequence[str],
    *,
    per_tile: bool = False,
    fit_shear: bool = False,
    reference_gain_sigma: float = 0.0,
) -> MountFit:
    """Fit tile gains, and optionally shear, against a plate.

    Args:
        pairs: our frames with the reference, its zero removed.
        force_n: (n, tiles), forces of the load-bearing tiles.
        tilt_loss: (n, tiles), 1 - cos of the angle between tile axis and vertical; NaN: unknown.
        serials: serials of the tiles.
        per_tile: fit a gain for each tile instead of one for all.
        fit_shear: fit the shear coefficient too.
        reference_gain_sigma: standard uncertainty of the reference's gain.

    Raises:
        CalibrationError: the load does not determine the requested parameters.
    """
    known = pairs.is_counted & np.isfinite(pairs.error_n) & np.isfinite(force_n).all(axis=1)
    known &= np.isfinite(tilt_loss).all(axis=1) | (not fit_shear)
    loaded = int((known & pairs.reference_contact).sum())
    if loaded < MIN_FRAMES:
        raise CalibrationError(
            f"{loaded} frames under load tell of the mounted foot",
            expected=f"at least {MIN_FRAMES} with a GRF, a reference"
            + (" and an angle" if fit_shear else ""),
        )
    grf_n, t_s = pairs.columns["grf_n"], pairs.t_s
    tiles = force_n.shape[1]
    load = _LoadedFrames(
        reference_n=pairs.reference_n[known],
        force_n=force_n[known],
        tilt_loss=np.nan_to_num(tilt_loss[known]) if fit_shear else np.zeros_like(force_n[known]),
        rate=np.gradient(grf_n, t_s)[known],
        gain_of=np.arange(tiles) if per_tile else np.zeros(tiles, dtype=np.intp),
        gains=tiles if per_tile else 1,
        with_shear=fit_shear,
    )
    names = [*(serials if per_tile else ("the foot",)), *(("the shear",) if fit_shear else ())]
    x, bend_n = load.fit()
    jacobian = load.compute_jacobian(x)
    _reject_collinear(jacobian, names)
    off_n = load.compute_residual_n(x)
    ratio = 1.0 + (off_n / bend_n) ** 2
    score, curvature = off_n / np.sqrt(ratio), ratio**-1.5
    step_s = float(np.median(np.diff(t_s)))
    samples = np.rint((t_s[known] - t_s[known][0]) / step_s).astype(np.int64)
    spread = compute_fit_uncertainty(jacobian, score, curvature, samples)
    own = compute_phase_covariance(jacobian, score, curvature, load.force_n.sum(axis=1))
    found = [
        _to_parameter(replace(spread, repeating_covariance=own).get_parameter(x, i))
        for i in range(len(x))
    ]
    gains = [
        Parameter(value=gain.value, sigma=math.hypot(gain.sigma, reference_gain_sigma * gain.value))
        for gain in found[_GAINS : _GAINS + load.gains]
    ]
    _reject_uncertain(gains, found[-1] if fit_shear else None, names)
    before_n, after_n = _cross_validate(load, pairs, known)
    return MountFit(
        gains=tuple(gains[g] for g in load.gain_of.tolist()),
        shear=found[-1] if fit_shear else None,
        residual_lag_s=found[_LATE],
        mae_before_n=before_n,
        mae_after_n=after_n,
        frame_count=loaded,
        block_count=spread.block_count,
    )


def _to_parameter(found: UncertainValue) -> Parameter:
    """Convert to a `Parameter` whose 1.96 sigma is Student's 95 % interval."""
    return Parameter(value=found.value, sigma=(found.interval_95[1] - found.value) / NORMAL_95)


def _reject_collinear(jacobian: Floats, names: Sequence[str]) -> None:
    """Reject parameters whose columns are zero or collinear."""
    size = np.linalg.norm(jacobian, axis=0)
    alike = size <= MIN_RELATIVE_EIGENVALUE * size.max()
    if not alike.any():
        values, vectors = np.linalg.eigh((jacobian / size).T @ (jacobian / size))
        if values[0] > MIN_RELATIVE_EIGENVALUE * values[-1]:
            return
        alike = np.abs(vectors[:, 0]) > 0.1 * np.abs(vectors[:, 0]).max()
    raise _make_undetermined_error(
        [name for name, one in zip(names, alike[_GAINS:], strict=True) if one]
    )


def _reject_uncertain(
    gains: Sequence[Parameter], shear: Parameter | None, names: Sequence[str]
) -> None:
    """Reject parameters with too large an uncertainty: see `MAX_GAIN_SIGMA`, `MAX_SHEAR_SIGMA`."""
    doubtful = [
        f"{name} ({gain.value:.3f} with a sigma of {gain.sigma:.3f})"
        for name, gain in zip(names, gains, strict=False)
        if not gain.sigma <= MAX_GAIN_SIGMA * abs(gain.value)
    ]
    if shear is not None and not shear.sigma <= MAX_SHEAR_SIGMA:
        doubtful.append(f"the shear ({shear.value:.2f} with a sigma of {shear.sigma:.2f})")
    if doubtful:
        raise _make_undetermined_error(doubtful)


def _make_undetermined_error(what: Sequence[str]) -> CalibrationError:
    if what[0].startswith("the foot") and len(what) == 1:
        return CalibrationError(
            f"the load does not determine {what[0]}",
            expected="several stances under one foot, all of which say the same",
            remedy="Record more stances; or calibrate from the part of the session that has them: "
            "foottile estimate --start-s --end-s",
        )
    return CalibrationError(
        f"the load does not determine {', '.join(what)}",
        expected="for a gain of each tile loads that go from tile to tile; for the shear tiles "
        "that are far from upright, at angles that change",
        remedy="Roll or tilt the foot over the plate, for longer; or ask for less: one gain for "
        "the foot, no shear",
    )


def _cross_validate(load: _LoadedFrames, pairs: PairedFrames, known: Bools) -> tuple[float, float]:
    """Compute the mean absolute error under load before, and cross-validated after, the fit."""
    contact = pairs.reference_contact[known]
    # Folds with equal numbers of loaded frames: there may be a few stances only.
    fold = (np.cumsum(contact) - contact) * CROSS_VALIDATION_BLOCKS // contact.sum() % 2
    before_n = np.abs(pairs.error_n[known])
    after_n = np.empty(len(contact))
    for judged in (0, 1):
        x, _ = load.select(fold != judged).fit()
        some = load.select(fold == judged)
        after_n[fold == judged] = np.abs(some.compute_grf_n(x) - some.reference_n)
    return float(before_n[contact].mean()), float(after_n[contact].mean())


@dataclass(frozen=True)
class MountCalibrationOptions:
    """Options of a calibration against a plate; see `foottile calibrate --help`."""

    stated: ReferenceOptions
    lag_range_s: tuple[float, float] | None = None
    per_tile: bool = False
    shear: bool = False
    reference_gain_sigma: float = 0.0
    reference: str = "not stated"


@dataclass(frozen=True)
class MountCalibrationResult:
    """Result of a calibration against a plate."""

    calibration: Calibration
    mount_fit: MountFit
    comparison: Comparison


def calibrate_mount(
    path: Path, reference_path: Path, options: MountCalibrationOptions, *, name: str
) -> MountCalibrationResult:
    """Extend a session's calibration by the mount's gains and shear, from a plate.

    Args:
        path: a sealed session with estimates and calibration.
        reference_path: the plate's recording.
        options: options of the fit.
        name: name of the new calibration.

    Raises:
        FileFormatError: a file cannot be read, or the session has no calibration.
        UsageError: a unit or sign of the reference is not stated.
        ComparisonError: the two cannot be compared.
        CalibrationError: the load does not determine the requested parameters.
    """
    requested = CompareOptions(
        stated=options.stated, lag_range_s=options.lag_range_s, remove_offset=True
    )
    with SealedFileReader(path) as session:
        info, calibration = session.info, _read_calibration(session)
    comparison = compare_session(path, reference_path, requested)
    if far := describe_implausible_alignment(comparison.alignment):
        raise CalibrationError(
            far[0],
            where=str(reference_path),
            remedy="Check its units, and that it is the plate's recording of this session",
        )
    pairs = comparison.pairs
    if not pairs.is_zero_removed:
        raise CalibrationError(
            "no flight is long enough to estimate the plate's zero",
            where=str(path),
            remedy="Lift the foot off the plate for a second before or after",
        )
    bearing = np.flatnonzero([not tile.reference for tile in info.tiles])
    serials = [info.tiles[i].serial for i in bearing]
    mount = fit_mount(
        pairs,
        comparison.tile_force_n[:, bearing],
        _compute_tilt_loss(info, pairs)[:, bearing],
        serials,
        per_tile=options.per_tile,
        fit_shear=options.shear,
        reference_gain_sigma=options.reference_gain_sigma,
    )
    before = calibration.mounted.gains if calibration.mounted is not None else {}
    gains = {
        serial: _combine_gains(gain, before[serial].value if serial in before else 1.0)
        for serial, gain in zip(serials, mount.gains, strict=True)
    }
    which = comparison.session.get("id") or path.name
    mounted = MountCalibration(
        reference=f"session {which} on {options.reference}, {reference_path.name}",
        gains=gains,
        shear=mount.shear,
    )
    made = calibration.model_copy(update={"name": name, "mounted": mounted})
    return MountCalibrationResult(made, mount, comparison)


def _read_calibration(session: SealedFileReader) -> Calibration:
    if (calibration := read_calibration_of_session(session)) is None:
        raise FileFormatError(
            "the session brings no calibration",
            where=str(session.path),
            remedy="Estimate it with one first: foottile estimate --calibration",
        )
    return calibration


def _compute_tilt_loss(info: ArrayInfo, pairs: PairedFrames) -> Floats:
    """Compute 1 - cos of the angle between each tile's axis and the vertical, (n, tiles)."""
    positions_m = np.array([(tile.x_m, tile.y_m, tile.z_m) for tile in info.tiles])
    bearing = np.array([not tile.reference for tile in info.tiles])
    axes = np.zeros(len(positions_m))
    axes[bearing] = fit_tile_axis_angles_rad(positions_m[bearing])
    turned_rad = np.zeros(len(pairs.t_s))
    if info.servo is not None:
        known = pairs.columns.get(ANGLE_COLUMN)
        turned_rad = np.full(len(pairs.t_s), np.nan) if known is None else known.astype(float)
    return compute_tilt_loss(axes - turned_rad[:, None])


def _combine_gains(gain: Parameter, before: float) -> Parameter:
    """Multiply a fitted gain by the session's gain; the new uncertainty replaces the old one."""
    return Parameter(value=gain.value * before, sigma=gain.sigma * before)
