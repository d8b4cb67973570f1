"""`foottile calibrate`: curves of tiles on a rig, gains of a mounted foot on a force plate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.commands.sessions import SERVER, ServerOption
from service.cli.options import (
    CaOption,
    JsonOption,
    parse_pair,
    print_json,
    remark,
    resolve_output_path,
    show_progress,
    stdout,
)
from service.cli.reference_options import (
    DecimalOption,
    EncodingOption,
    LagRangeOption,
    ReferenceColumnsOption,
    ReferenceRateOption,
    ReferenceSignOption,
    ReferenceUnitsOption,
    SkipRowsOption,
    UnitsRowOption,
    make_reference_options,
)
from storage.sessions.folder import FRAMES_NAME

DELAY_MAX_MS = 1000.0
"""Largest delay of a usable reference."""


@require_extra("server", "`foottile calibrate`")
def calibrate_command(
    out: Annotated[Path, typer.Option(help="Calibration file to write (JSON).")],
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="IN...",
            help="Rig recordings; several may have repeats of one tile.",
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Guided dead weights on a tile of a running node."),
    ] = False,
    tile: Annotated[
        str | None, typer.Option(help="With --live: serial of the tile, or several: T01,T02.")
    ] = None,
    weights: Annotated[
        str,
        typer.Option(help="With --live: weights in order; g, kg or N."),
    ] = "200g,500g,1kg,1.5kg,2kg",
    within_percent: Annotated[
        float,
        typer.Option(min=0.0, max=50.0, help="With --live: tolerance of each weight."),
    ] = 1.0,
    node: Annotated[
        str | None, typer.Option(help="With --live: the node; default: the only one.")
    ] = None,
    assign: Annotated[
        bool, typer.Option("--assign", help="With --live: assign the calibration to the node.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --live: accept the result without a prompt.")
    ] = False,
    server: ServerOption = None,
    ca: CaOption = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the calibration; default: the file's name.")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="PNG for curves, residuals, a release and a tap."),
    ] = None,
    sensor: Annotated[
        str, typer.Option(help="Name of the force sensor, for the calibration file.")
    ] = "not stated",
    reference_delay_ms: Annotated[
        float | None,
        typer.Option(help="Delay of its readings; default: unknown, with larger uncertainty."),
    ] = None,
    reference_delay_sigma_ms: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Standard uncertainty of the delay.")
    ] = 0.1,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Force plate recording under the foot of session IN: fit the mounted foot, keep "
            "the curves."
        ),
    ] = None,
    per_tile: Annotated[
        bool, typer.Option("--per-tile", help="With --reference: fit a gain for each tile.")
    ] = False,
    shear: Annotated[
        bool,
        typer.Option("--shear", help="With --reference: fit the shear direction on tilted tiles."),
    ] = False,
    reference_gain_sigma: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="With --reference: uncertainty of the plate's gain."),
    ] = 0.0,
    columns: ReferenceColumnsOption = None,
    units: ReferenceUnitsOption = None,
    sign: ReferenceSignOption = None,
    rate_hz: ReferenceRateOption = None,
    skip_rows: SkipRowsOption = None,
    units_row: UnitsRowOption = None,
    decimal: DecimalOption = None,
    encoding: EncodingOption = None,
    lag_range_s: LagRangeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit curve and effects of every tile in the recordings, with confidence intervals.

    A recording is a session with reference_force_n, pressed_tile and phase, from an indenter or
    `foottile simulate --scene indentation`, or a session whose markers name weight and tile. --live
    guides through dead weights on tiles of a running node; the server fits them
    (docs/calibrate-a-tile.md). --reference fits the mounted foot of a session to a force plate:
    gains of the foot or of its tiles, and shear. A tile without a plausible curve, or a parameter
    that the load does not determine, is refused with the reason. Exit codes: 0 success, 1 no tile
    has a curve, 2 wrong usage, 3 written but a tile was refused, or, with --live, not accepted and
    not written.
    """
    if live:
        if recordings or tile is None or reference is not None or plot is not None:
            raise UsageError(
                "--live goes with --tile, and without recordings, --plot and --reference",
                remedy="foottile calibrate --live --tile T01 --out cal.json",
            )
        from service.cli.commands.calibrate_live import WeighingRequest, calibrate_live

        calibrate_live(
            resolve_output_path(out),
            WeighingRequest(
                tiles=tuple(part.strip() for part in tile.split(",")),
                weights=weights,
                within_percent=within_percent,
                node=node,
                name=name or f"{tile}, dead weights",
                reference="dead weights" if sensor == "not stated" else sensor,
                assign=assign,
                yes=yes,
            ),
            server or SERVER,
            ca,
            as_json=as_json,
        )
        return
    if not recordings:
        raise UsageError("no recording is named", expected="IN..., or --live with --tile")
    if tile is not None or assign or yes or node is not None or server is not None:
        raise UsageError(
            "--tile, --node, --server, --assign and --yes go with --live", remedy="Add --live"
        )
    stated = {
        "map": columns,
        "units": units,
        "sign": sign,
        "skip_rows": skip_rows,
        "units_row": units_row,
        "decimal": decimal,
        "encoding": encoding,
    }
    if reference is not None:
        if len(recordings) > 1 or plot is not None or reference_delay_ms is not None:
            raise UsageError(
                "--reference goes with one session, and without --plot and --reference-delay-ms"
            )
        from service.cli.commands.calibrate_mount import calibrate_mounted_foot
        from service.offline.mount_calibration import MountCalibrationOptions

        options = MountCalibrationOptions(
            stated=make_reference_options(stated, rate_hz),
            lag_range_s=parse_pair(lag_range_s, "--lag-range-s"),
            per_tile=per_tile,
            shear=shear,
            reference_gain_sigma=reference_gain_sigma,
            reference=sensor,
        )
        calibrate_mounted_foot(recordings[0], reference, out, options, as_json=as_json)
        return
    for_plate = (*stated.values(), rate_hz, lag_range_s)
    if per_tile or shear or reference_gain_sigma or any(each is not None for each in for_plate):
        raise UsageError("these options go with --reference", remedy="Add --reference FILE")
    from service.cli.calibration_report import calibration_to_json, make_calibration_tables
    from service.estimation.effects import Parameter
    from service.estimation.fitting.rig.loading import has_weights
    from service.estimation.fitting.sample_delay import DEFAULT_REFERENCE_DELAY
    from service.offline.calibration_fit import fit_calibration, read_indentations
    from service.sessions.calibration_file import write_calibration
    from storage.durable_files import write_atomically

    delay = DEFAULT_REFERENCE_DELAY
    if reference_delay_ms is not None:
        if not abs(reference_delay_ms) <= DELAY_MAX_MS:
            raise UsageError(
                f"--reference-delay-ms {reference_delay_ms:g}", expected=f"within {DELAY_MAX_MS:g}"
            )
        delay = Parameter(value=1e-3 * reference_delay_ms, sigma=1e-3 * reference_delay_sigma_ms)
    path = resolve_output_path(out, *recordings)
    plot_path = resolve_output_path(plot, out, *recordings) if plot is not None else None
    with show_progress("fitting"):
        pressed = read_indentations(
            [each / FRAMES_NAME if each.is_dir() else each for each in recordings]
        )
        if plot_path is not None and any(
            has_weights(one.indentation) for each in pressed.values() for one in each
        ):
            raise UsageError("--plot draws strokes of an indenter, and these are dead weights")
        calibration = fit_calibration(
            pressed,
            name=name or path.stem,
            reference_name=sensor,
            reference_delay=delay,
            on_progress=remark,
        )
        png = None
        if plot_path is not None:
            from service.offline.calibration_plot import plot_calibration

            png = plot_calibration(
                calibration,
                {serial: [one.indentation for one in each] for serial, each in pressed.items()},
            )
    write_calibration(path, calibration)
    if plot_path is not None and png is not None:
        write_atomically(plot_path, png)
    if as_json:
        print_json(calibration_to_json(calibration))
    else:
        for table in make_calibration_tables(calibration):
            stdout.print(table)
    for serial, reason in calibration.refused.items():
        remark(f"tile {serial} refused: {reason}")
    if calibration.refused:
        raise typer.Exit(3)
