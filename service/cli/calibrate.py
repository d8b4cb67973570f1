"""`foottile calibrate`: curves of tiles from indentation recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import JsonOption, output_path, print_json, progress, stdout


def calibrate_command(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="IN...", help="Indentation recordings.")
    ],
    out: Annotated[Path, typer.Option(help="Calibration file to write (JSON).")],
    plot: Annotated[
        Path | None, typer.Option(help="Draw curves and residuals to this PNG.")
    ] = None,
    reference: Annotated[
        str, typer.Option(help="The force sensor that the scale comes from.")
    ] = "not stated",
    as_json: JsonOption = False,
) -> None:
    """Fit every tile that was pressed in the recordings, and say how good the fit is.

    A recording is a session with reference_force_n, pressed_tile and phase, as the mill or
    `foottile simulate --scene indentation` makes it. Exit codes: 0 good, 1 failed, 2 wrong usage.
    """
    from service.calibrate import calibrate
    from service.cli.report import calibration_json, calibration_table
    from storage.durable import write_whole

    path = output_path(out, *recordings)
    plot_path = output_path(plot, out, *recordings) if plot is not None else None
    with progress("fitting"):
        calibration = calibrate(recordings, name=path.stem, reference=reference)
        png = None
        if plot_path is not None:
            from service.plots import plot_calibration

            png = plot_calibration(calibration, recordings)
    write_whole(path, calibration.to_json().encode())
    if plot_path is not None and png is not None:
        write_whole(plot_path, png)
    if as_json:
        print_json(calibration_json(calibration))
    else:
        stdout.print(calibration_table(calibration))
