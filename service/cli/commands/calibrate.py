"""`foottile calibrate`: from recordings, with weights on a running node, and as mounted.

With `--live` the server guides, records and fits, as for the page `/calibrate`, and this module
prints its prompts.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from devices.errors import CalibrationError, UsageError, require_extra
from service.cli.commands.sessions import SERVER, ServerOption, find_sealed_file
from service.cli.options import (
    CaOption,
    JsonOption,
    add_options,
    exit_incomplete_for,
    parse_pair,
    print_json,
    remark,
    resolve_output_path,
    show_progress,
    stderr,
    stdout,
)
from service.cli.reference_options import LagRangeOption, TableOptions, make_reference_options
from storage.sessions.folder import FRAMES_NAME

if TYPE_CHECKING:
    from foottile.client import Client
    from service.estimation.calibration import Calibration
    from service.offline.mount_calibration import MountCalibrationOptions

DELAY_MAX_MS = 1000.0
"""Largest delay of a usable reference."""
_POLL_S = 0.3
_EXIT_NOT_ACCEPTED = 3


@dataclass(frozen=True)
class WeighingRequest:
    """Tiles, weights and options of a weighing; see `foottile calibrate --help`."""

    tiles: tuple[str, ...]
    weights: str
    within_percent: float
    node: str | None
    name: str
    reference: str
    assign: bool
    yes: bool


def calibrate_live(
    out: Path, request: WeighingRequest, server: str, ca: Path | None, *, as_json: bool
) -> None:
    """Guide through the weights, fit, show, and write the calibration if accepted.

    Raises:
        UsageError: no such node or tile, or an invalid weight.
        CalibrationError: the weights give no curve.
    """
    import foottile
    from service.cli.calibration_report import make_calibration_json, make_calibration_tables
    from service.estimation.dead_weights import check_and_label_weights
    from service.sessions.calibration_file import parse_calibration
    from storage.durable_files import write_atomically

    weights = check_and_label_weights([request.weights], request.within_percent)
    with foottile.connect(server, ca=ca) as source:
        node = _select_node(source, request.node)
        _check_assignable(node, request)
        path = f"/nodes/{quote(node['node'], safe='')}/weighing"
        body = {
            "tiles": list(request.tiles),
            "weights": list(weights),
            "reference": request.reference,
            "name": request.name,
        }
        while True:
            weighing = _weigh(source, path, body)
            found = weighing["result"]["calibration_id"]
            with source.http.stream(f"/calibrations/{found}") as file:
                content = file.read()
            calibration = parse_calibration(content, where=f"calibration {found}")
            if not as_json:
                for table in make_calibration_tables(calibration):
                    stdout.print(table)
            answer = "y" if request.yes else _ask_to_accept()
            if answer == "y":
                break
            source.http.send("DELETE", f"/calibrations/{found}")
            if answer == "n":
                remark(f"not accepted; its recording is session {weighing['session_id']}")
                raise typer.Exit(_EXIT_NOT_ACCEPTED)
        write_atomically(out, content)
        if request.assign:
            _assign(source, node, calibration)
    if as_json:
        print_json(
            {**make_calibration_json(calibration), "session": weighing["session_id"], "out": out}
        )
    else:
        remark(f"written: {out}; its recording is session {weighing['session_id']}")


def _select_node(source: Client, name: str | None) -> dict[str, Any]:
    if name is not None:
        return source.node(name)
    nodes = [node for node in source.nodes() if node["connected"]]
    if len(nodes) != 1:
        raise UsageError(
            f"{len(nodes)} nodes are connected", expected="one", remedy="Name one: --node NAME"
        )
    return nodes[0]


def _check_assignable(node: dict[str, Any], request: WeighingRequest) -> None:
    """Reject early a calibration that the node could not use.

    Raises:
        UsageError: tiles of the node are missing.
    """
    needed = [tile["serial"] for tile in node["tiles"] if not tile["reference"]]
    if request.assign and (missing := [each for each in needed if each not in request.tiles]):
        raise UsageError(
            f"--assign without tile {', '.join(missing)}: a node needs a curve of every tile",
            remedy=f"Calibrate all: --tile {','.join(needed)}; or put the recordings of single "
            "tiles together with foottile calibrate SESSION...",
        )


def _weigh(source: Client, path: str, body: dict[str, Any]) -> dict[str, Any]:
    """Run a guided weighing on the server, print its prompts and return it when done.

    Raises:
        CalibrationError: the weighing ended without a calibration.
    """
    import foottile

    weighing = source.http.send("POST", path, body)
    try:
        weighing = _show_until_done(source, path, weighing)
    finally:  # cancels a running weighing, or closes it on the page
        with suppress(foottile.ClientError):
            source.http.send("DELETE", path, headers={"If-Match": weighing["session_id"]})
    if weighing["state"] == "failed":
        raise CalibrationError(
            f"no calibration: {weighing['problem']}", where=f"session {weighing['session_id']}"
        )
    return weighing


def _show_until_done(source: Client, path: str, weighing: dict[str, Any]) -> dict[str, Any]:
    """Show the progress of a weighing until its end.

    Raises:
        CalibrationError: a user cancelled the weighing.
    """
    printed, warned, printed_count = "", None, 0
    with show_progress(weighing["prompt"]) as show_status:
        while weighing["state"] in ("weighing", "fitting"):
            if weighing["warning"] not in (None, warned):
                remark(f"repeat: {weighing['warning']}")
            warned = weighing["warning"]
            texts = _format_done_weights(weighing)
            for text in texts[printed_count:]:
                remark(text)
            printed_count = len(texts)
            text = _format_status(weighing)
            if text != printed:
                printed = text
                show_status(text)
            time.sleep(_POLL_S)
            found = source.http.get(path)["weighing"]
            if found is None or found["session_id"] != weighing["session_id"]:
                raise CalibrationError("the weighing was cancelled on the server")
            weighing = found
    return weighing


def _format_done_weights(weighing: dict[str, Any]) -> list[str]:
    """Return a line for each finished weight."""
    return [
        f"{tile['serial']} {weight}: {_format_reading(reading)}"
        for tile in weighing["tiles"]
        for weight, reading in zip(weighing["weights"], tile["held"], strict=False)
    ]


def _format_reading(reading: dict[str, float]) -> str:
    return (
        f"{reading['mean_kpa']:.2f} kPa, spread {reading['spread_kpa']:.3f}, "
        f"settled by {reading['settle_kpa']:+.3f}"
    )


def _format_status(weighing: dict[str, Any]) -> str:
    if weighing["state"] == "fitting":
        return "fitting"
    if weighing["left_s"] is None or not stderr.is_terminal:
        return str(weighing["prompt"])
    reading = weighing["repeatability"]
    live = "" if reading is None else f"; {_format_reading(reading)}"
    return f"{weighing['prompt']}: {weighing['left_s']:.0f} s{live}"


def _ask_to_accept() -> str:
    """Prompt and return y, r or n; n without an input."""
    try:
        answer = typer.prompt("Accept it? y: yes, r: repeat, n: no", err=True).strip().lower()
    except typer.Abort:
        return "n"
    return answer[:1] if answer[:1] in ("y", "r") else "n"


def _assign(source: Client, node: dict[str, Any], calibration: Calibration) -> None:
    path = f"/nodes/{quote(node['node'], safe='')}/calibration"
    source.http.send("PUT", path, {"id": calibration.id})
    remark(f"node {node['node']} now uses it")


@require_extra("server", "`foottile calibrate`")
@add_options
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
    *,
    table: TableOptions,
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
    if reference is not None:
        if len(recordings) > 1 or plot is not None or reference_delay_ms is not None:
            raise UsageError(
                "--reference goes with one session, and without --plot and --reference-delay-ms"
            )
        from service.offline.mount_calibration import MountCalibrationOptions

        options = MountCalibrationOptions(
            stated=make_reference_options(vars(table), table.rate_hz),
            lag_range_s=parse_pair(lag_range_s, "--lag-range-s"),
            per_tile=per_tile,
            shear=shear,
            reference_gain_sigma=reference_gain_sigma,
            reference=sensor,
        )
        _calibrate_mounted_foot(recordings[0], reference, out, options, as_json=as_json)
        return
    for_plate = table != TableOptions() or lag_range_s is not None
    if per_tile or shear or reference_gain_sigma or for_plate:
        raise UsageError("these options go with --reference", remedy="Add --reference FILE")
    calibration = _fit_recordings(
        recordings,
        out,
        plot,
        name=name,
        sensor=sensor,
        reference_delay_ms=reference_delay_ms,
        reference_delay_sigma_ms=reference_delay_sigma_ms,
        as_json=as_json,
    )
    exit_incomplete_for(
        [f"tile {serial} refused: {reason}" for serial, reason in calibration.refused.items()]
    )


def _fit_recordings(
    recordings: list[Path],
    out: Path,
    plot: Path | None,
    *,
    name: str | None,
    sensor: str,
    reference_delay_ms: float | None,
    reference_delay_sigma_ms: float,
    as_json: bool,
) -> Calibration:
    """Fit the tiles of rig recordings, write and print the calibration."""
    from service.cli.calibration_report import make_calibration_json, make_calibration_tables
    from service.estimation.effects import Parameter
    from service.estimation.fitting.effects_fit import DEFAULT_REFERENCE_DELAY
    from service.estimation.fitting.weights_fit import has_weights
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
        print_json(make_calibration_json(calibration))
    else:
        for result in make_calibration_tables(calibration):
            stdout.print(result)
    return calibration


def _calibrate_mounted_foot(
    session: Path, reference: Path, out: Path, options: MountCalibrationOptions, *, as_json: bool
) -> None:
    """Fit a mounted foot to a force plate."""
    from service.cli.calibration_report import make_mount_json, make_mount_table
    from service.offline.mount_calibration import calibrate_mount
    from service.sessions.calibration_file import write_calibration

    source = find_sealed_file(str(session), None)
    path = resolve_output_path(out, source, reference)
    with show_progress(f"calibrating {session.name} against {reference.name}"):
        found = calibrate_mount(source, reference, options, name=path.stem)
    write_calibration(path, found.calibration)
    if as_json:
        print_json(make_mount_json(found))
    else:
        stdout.print(make_mount_table(found))
    if options.reference_gain_sigma == 0.0:
        remark("the plate's gain is assumed exact; --reference-gain-sigma states its uncertainty")
    for note in found.comparison.notes:
        remark(note)
