"""`foottile calibrate`: curves of tiles from indentation recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from devices.errors import UsageError, needs_extra
from service.cli.options import JsonOption, output_path, print_json, progress, remark, stdout

DELAY_MAX_MS = 1000.0
"""No reference of use here is later."""


@needs_extra("server", "`foottile calibrate`")
def calibrate_command(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="IN...",
            help="Indentation recordings; repeats of a tile may be spread over several.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Calibration file to write (JSON).")],
    plot: Annotated[
        Path | None,
        typer.Option(help="Draw curves, residuals, a release and a tap to this PNG."),
    ] = None,
    reference: Annotated[
        str, typer.Option(help="The force sensor that the scale comes from.")
    ] = "not stated",
    reference_delay_ms: Annotated[
        float | None,
        typer.Option(help="How late its readings are; default: not known, which costs certainty."),
    ] = None,
    reference_delay_sigma_ms: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Standard uncertainty of that.")
    ] = 0.1,
    as_json: JsonOption = False,
) -> None:
    """Fit every tile that was pressed in the recordings, and say how good the fit is.

    A recording is a session with reference_force_n, pressed_tile and phase, as the mill or
    `foottile simulate --scene indentation` makes it. A tile whose recording gives no believable
    curve is refused with the reason. Exit codes: 0 good, 1 failed, no tile has a curve, 2 wrong
    usage, 3 written, but a tile was refused.
    """
    from service.cli.calibration_report import calibration_json, calibration_tables
    from service.estimation.effects import Parameter
    from service.estimation.fitting.timing import UNKNOWN_DELAY
    from service.offline.calibrate import calibrate_recordings, read_recordings
    from service.offline.calibrations import write_calibration
    from storage.durable import write_whole

    delay = UNKNOWN_DELAY
    if reference_delay_ms is not None:
        if not abs(reference_delay_ms) <= DELAY_MAX_MS:
            raise UsageError(
                f"--reference-delay-ms {reference_delay_ms:g}", expected=f"within {DELAY_MAX_MS:g}"
            )
        delay = Parameter(value=1e-3 * reference_delay_ms, sigma=1e-3 * reference_delay_sigma_ms)
    path = output_path(out, *recordings)
    plot_path = output_path(plot, out, *recordings) if plot is not None else None
    with progress("fitting"):
        pressed = read_recordings(recordings)
        calibration = calibrate_recordings(
            pressed, name=path.stem, reference=reference, delay=delay, progress=remark
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
        write_whole(plot_path, png)
    if as_json:
        print_json(calibration_json(calibration))
    else:
        for table in calibration_tables(calibration):
            stdout.print(table)
    for serial, reason in calibration.refused.items():
        remark(f"tile {serial} refused: {reason}")
    if calibration.refused:
        raise typer.Exit(3)
