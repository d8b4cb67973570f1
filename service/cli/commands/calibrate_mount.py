"""`foottile calibrate --reference`: calibration of a mounted foot on a force plate."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from service.cli.commands.sessions import find_sealed_file
from service.cli.options import print_json, remark, resolve_output_path, show_progress, stdout
from service.estimation.effects import Parameter
from service.offline.mount_calibration import (
    MountCalibrationOptions,
    MountCalibrationResult,
    calibrate_mount,
)
from service.sessions.calibration_file import write_calibration


def calibrate_mounted_foot(
    session: Path, reference: Path, out: Path, options: MountCalibrationOptions, *, as_json: bool
) -> None:
    """Fit a mounted foot to a force plate; see `foottile calibrate --help`."""
    source = find_sealed_file(str(session), None)
    path = resolve_output_path(out, source, reference)
    with show_progress(f"calibrating {session.name} against {reference.name}"):
        found = calibrate_mount(source, reference, options, name=path.stem)
    write_calibration(path, found.calibration)
    if as_json:
        print_json(_make_json(found))
    else:
        stdout.print(_make_table(found))
    if options.reference_gain_sigma == 0.0:
        remark("the plate's gain is assumed exact; --reference-gain-sigma states its uncertainty")
    for note in found.comparison.notes:
        remark(note)


def _make_json(found: MountCalibrationResult) -> dict[str, object]:
    mounted, mount = found.calibration.mounted, found.mount_fit
    return {
        "id": found.calibration.id,
        "reference": None if mounted is None else mounted.reference,
        "gains": {}
        if mounted is None
        else {serial: _make_parameter_json(gain) for serial, gain in mounted.gains.items()},
        "shear": None if mount.shear is None else _make_parameter_json(mount.shear),
        "mae_before_n": mount.mae_before_n,
        "mae_after_n": mount.mae_after_n,
        "frames": mount.frame_count,
        "blocks": mount.block_count,
        "late_s": _make_parameter_json(mount.residual_lag_s),
    }


def _make_parameter_json(found: Parameter) -> dict[str, object]:
    return {"value": found.value, "sigma": found.sigma, "interval_95": found.interval_95}


def _make_table(found: MountCalibrationResult) -> Table:
    mounted, mount = found.calibration.mounted, found.mount_fit
    table = Table(
        title=f"Calibration {found.calibration.name} ({found.calibration.id}), as mounted",
        caption=(
            f"GRF under load, mean absolute error: {mount.mae_before_n:.3f} N before, "
            f"{mount.mae_after_n:.3f} N after,\neach stretch by a fit to the others; "
            f"{mount.frame_count} frames"
        ),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for heading in ("", "value", "95 % interval"):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=True)
    rows = [] if mounted is None else [(f"gain {name}", one) for name, one in mounted.gains.items()]
    if mount.shear is not None:
        rows.append(("shear", mount.shear))
    for name, found_one in rows:
        low, high = found_one.interval_95
        table.add_row(name, f"{found_one.value:.4f}", f"{low:.4f} to {high:.4f}")
    return table
