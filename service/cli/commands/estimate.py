"""`foottile estimate`: forces, GRF and COP of a recorded session."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from devices.errors import needs_extra
from service.cli.options import (
    EndOption,
    ExactOption,
    JsonOption,
    StartOption,
    output_path,
    pair,
    print_json,
    progress,
    remark,
    say,
)
from service.estimation import OFFLINE_LAG_MS


@needs_extra("server", "`foottile estimate`")
def estimate_command(
    session: Annotated[Path, typer.Argument(metavar="IN.parquet", help="Session to estimate.")],
    out: Annotated[Path, typer.Option(help="Session to write, with the new estimates.")],
    calibration: Annotated[
        str | None,
        typer.Option(
            help="Calibration file, preset, 'bench', or the id of the one in the session; default: "
            "the one in the session, else the scene's."
        ),
    ] = None,
    models: Annotated[
        str | None, typer.Option(help="Comma-separated; default: those of the scene.")
    ] = None,
    lag_ms: Annotated[
        float, typer.Option(help="Look-ahead of smoothing and contact.")
    ] = OFFLINE_LAG_MS,
    scene: Annotated[
        str | None,
        typer.Option(help="Scene whose models, calibration and tile positions to use."),
    ] = None,
    tare_s: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Unloaded interval in seconds from the first frame."),
    ] = None,
    start_s: StartOption = None,
    end_s: EndOption = None,
    exact: ExactOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate a recorded session again and write it with the new estimates.

    The tare comes from --tare-s, else from frames flagged as lead, else from the first interval
    that can be recognised as unloaded. Of some seconds no more is read than they need: models begin
    some time before them, and do not remember what was before that.

    Exit codes: 0 good, 1 failed, 2 wrong usage.
    """
    from service.cli.report import findings_json, tell_findings
    from service.estimation.asked import SEEN
    from service.offline.estimate import estimate_session
    from storage.formats.slice import Slice

    # The session itself may be the output: it is replaced whole, and nothing raw is lost.
    path = output_path(out, *(Path(name) for name in (calibration, scene) if name is not None))
    with progress(f"estimating {session}"):
        result = estimate_session(
            session,
            path,
            calibration=calibration,
            models=None if models is None else tuple(models.split(",")),
            lag_ms=lag_ms,
            scene=scene,
            tare_s=pair(tare_s, "--tare-s"),
            part=Slice(start_s, end_s),
            exact=exact,
            remark=remark,
        )
    plan = result.plan
    if as_json:
        print_json(
            {
                "out": path,
                "frames": result.frames,
                "calibration_id": plan.calibration.id,
                "models": plan.models,
                "lag_ms": lag_ms,
                "tare": {
                    "source": plan.tare.source,
                    "begin_s": plan.tare.begin_s,
                    "end_s": plan.tare.end_s,
                },
                "asks_for": result.asked,
                **findings_json(result.findings),
            }
        )
        return
    say(
        f"{path}: {result.frames} frames, calibration {plan.calibration.name} "
        f"({plan.calibration.id}), models {', '.join(plan.models)}, tare {plan.tare.source} "
        f"{plan.tare.begin_s:.2f} to {plan.tare.end_s:.2f} s"
    )
    tell_findings(result.findings)
    for name, newtons in result.asked.items():
        remark(
            f"{SEEN[name]}: model {name!r} is not named, and is good for {newtons:.2f} N of the "
            "GRF here; the calibration offers it"
        )
