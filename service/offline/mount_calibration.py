"""Calibration of a mounted foot from a session on a force plate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import CalibrationError, FileFormatError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.effects import Parameter
from service.estimation.foot.geometry import fit_tile_axis_angles_rad
from service.estimation.mounting import MountCalibration
from service.offline.compare.mount_fit import MountFit, fit_mount
from service.offline.compare.paired_frames import PairedFrames
from service.offline.compare.plausibility import describe_implausible_alignment
from service.offline.comparison import ANGLE_COLUMN, CompareOptions, Comparison, compare_session
from storage.formats.reference import ReferenceOptions
from storage.sessions.reader import SealedFileReader


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
        against=f"session {which} on {options.reference}, {reference_path.name}",
        gains=gains,
        shear=mount.shear,
    )
    made = calibration.model_copy(update={"name": name, "mounted": mounted})
    return MountCalibrationResult(made, mount, comparison)


def _read_calibration(session: SealedFileReader) -> Calibration:
    if "calibration" not in session.notes:
        raise FileFormatError(
            "the session brings no calibration",
            where=str(session.path),
            remedy="Estimate it with one first: foottile estimate --calibration",
        )
    try:
        return Calibration.model_validate(session.notes["calibration"])
    except ValueError as error:
        raise FileFormatError(
            f"its calibration is not readable: {error}", where=str(session.path)
        ) from error


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
    return np.asarray(1.0 - np.cos(axes - turned_rad[:, None]))


def _combine_gains(gain: Parameter, before: float) -> Parameter:
    """Multiply a fitted gain by the session's gain; the new uncertainty replaces the old one."""
    return Parameter(value=gain.value * before, sigma=gain.sigma * before)
