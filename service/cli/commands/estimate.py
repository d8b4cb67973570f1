"""`foottile estimate`: new estimates of a recorded session."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError, require_extra
from service.cli.multi_session import BatchOptions, is_single_session, run_task
from service.cli.options import (
    EXIT_INCOMPLETE,
    EndOption,
    EstimatorOption,
    JsonOption,
    StartOption,
    UnquantizedOption,
    add_options,
    echo,
    parse_pair,
    print_json,
    remark,
    resolve_output_path,
    show_progress,
)
from service.estimation import OFFLINE_LAG_MS
from storage.sessions.folder import FRAMES_NAME

if TYPE_CHECKING:
    from service.estimation.calibration import Calibration
    from service.offline.estimate_summary import EstimateChange


@require_extra("server", "`foottile estimate`")
@add_options
def estimate_command(
    out: Annotated[
        str,
        typer.Option(
            help="Session to write, .parquet is added to a name without a suffix; for many "
            "sessions, a folder or URI."
        ),
    ],
    sessions: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="IN.parquet ...", help="Session to estimate; or many: folders, globs, URIs."
        ),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            help="Calibration file, preset, 'emulated-rig', or id of the session's calibration; "
            "default: the session's, else the scene's."
        ),
    ] = None,
    models: Annotated[
        str | None, typer.Option(help="Comma-separated models; default: the scene's.")
    ] = None,
    lag_ms: Annotated[
        float, typer.Option(help="Look-ahead of smoothing and contact.")
    ] = OFFLINE_LAG_MS,
    estimator: EstimatorOption = "models",
    scene: Annotated[
        str | None,
        typer.Option(help="Scene for models, calibration and tile positions."),
    ] = None,
    tare_s: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Unloaded interval in seconds from the first frame."),
    ] = None,
    angle: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE",
            help="Angle of the foot in place of the servo's, as `foottile video track` writes it.",
        ),
    ] = None,
    start_s: StartOption = None,
    end_s: EndOption = None,
    unquantized: UnquantizedOption = False,
    *,
    batch: BatchOptions,
    as_json: JsonOption = False,
) -> None:
    """Estimate a recorded session again and write it with the new estimates.

    The tare comes from --tare-s, else from frames flagged as lead, else from the first interval
    recognised as unloaded. For a slice the models start some time before it, in their initial
    state, and only that part is read.

    Many sessions are estimated in parallel processes, each into a folder of its id in --out; a
    repeated command resumes.

    Exit codes: 0 success, 1 failure, 2 wrong usage, 3 some of many sessions failed.
    """
    from devices.scene.scene_file import load_scene
    from service.cli.report import make_findings_json, print_findings
    from service.estimation.estimate import ModelEstimator
    from service.estimation.model_sensitivity import REASONS_BY_MODEL
    from service.offline.archive.locations import is_remote
    from service.offline.archive.tasks import EstimateTask
    from service.offline.estimate.session import estimate_session
    from service.offline.estimate.table_angle import check_film_of_session, read_angle_track
    from service.offline.estimate_summary import compute_estimate_change, read_stored_estimates
    from storage.formats.slice import Slice
    from studies.estimators import get_estimator

    used = get_estimator(estimator)
    if used is not ModelEstimator:
        if models is not None or lag_ms != OFFLINE_LAG_MS:
            raise UsageError(
                f"--estimator {estimator} takes no --models and no --lag-ms",
                expected="one or the other",
            )
        models, lag_ms = "static", 0.0
    task = EstimateTask(
        calibration=calibration,
        models=None if models is None else tuple(models.split(",")),
        lag_ms=lag_ms,
        scene=None if scene is None else load_scene(scene),
        tare_s=parse_pair(tare_s, "--tare-s"),
        part=Slice(start_s, end_s),
        unquantized=unquantized,
        estimator=used,
    )
    if not is_single_session(sessions, batch.manifest) or is_remote(out):
        if angle is not None:
            raise UsageError("--angle is the table of one session", expected="one session")
        task = replace(task, calibration=_embed_calibration(calibration))
        summary = run_task(task, sessions, batch, out=out, as_json=as_json)
        if summary.states["failed"]:
            raise typer.Exit(EXIT_INCOMPLETE)
        return
    (session,) = map(Path, sessions or ())
    # The output may be the input: it is replaced atomically, and keeps all raw data.
    path = resolve_output_path(
        _add_suffix(Path(out)),
        *(Path(name) for name in (calibration, scene, angle) if name is not None),
    )
    source = session / FRAMES_NAME if session.is_dir() else session
    track = None if angle is None else read_angle_track(angle)
    if angle is not None:
        check_film_of_session(angle, source)
    with show_progress(f"estimating {session}"):
        before = read_stored_estimates(source)
        result = estimate_session(source, path, task, on_remark=remark, angle=track)
        after = None if before is None else read_stored_estimates(path)
    change = None if before is None or after is None else compute_estimate_change(before, after)
    plan = result.plan
    if as_json:
        print_json(
            {
                "out": path,
                "frames": result.frame_count,
                "calibration_id": plan.calibration.id,
                "models": plan.models,
                "estimator": used.name,
                "lag_ms": lag_ms,
                "change": change,
                "tare": {
                    "source": plan.tare.source,
                    "begin_s": result.tare_s[0],
                    "end_s": result.tare_s[1],
                },
                "omitted_effects_n": result.omitted_effects_n,
                **make_findings_json(result.findings),
            }
        )
        return
    made_by = f"models {', '.join(plan.models)}" if used is ModelEstimator else used.name
    echo(
        f"{path}: {result.frame_count} frames, calibration {plan.calibration.name} "
        f"({plan.calibration.id}), {made_by}, tare {plan.tare.source} "
        f"{result.tare_s[0]:.2f} to {result.tare_s[1]:.2f} s"
    )
    echo(f"look-ahead {lag_ms:g} ms{_format_change(change)}")
    print_findings(result.findings)
    for name, newtons in result.omitted_effects_n.items():
        remark(
            f"{REASONS_BY_MODEL[name]}: model {name!r} is inactive; it would change the GRF by "
            f"{newtons:.2f} N here, and the calibration has it"
        )


def _add_suffix(out: Path) -> Path:
    """Return the path with a suffix, from which programs recognise the format."""
    return out if out.suffix or os.path.lexists(out) else out.with_name(f"{out.name}.parquet")


def _format_change(change: EstimateChange | None) -> str:
    if change is None:
        return ""
    before = f" (before: {change.lag_before_ms:g} ms)"
    if not change.frames:
        return before
    return (
        f"{before}; GRF changes by {change.grf_rms_n:.2f} N (RMS), "
        f"{change.grf_most_n:.2f} N at most, contact in {change.contact_frames} of "
        f"{change.frames} frames"
    )


def _embed_calibration(calibration: str | None) -> Calibration | str | None:
    """Replace the name of a calibration file by its content, for workers on other machines."""
    from service.offline.calibration_lookup import read_calibration

    if calibration is None or not Path(calibration).is_file():
        return calibration
    return read_calibration(Path(calibration))
