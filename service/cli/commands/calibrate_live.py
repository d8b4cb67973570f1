"""`foottile calibrate --live`: dead weights on a tile of a running node.

The server guides, records and fits, as for the page `/calibrate`; this module prints its prompts.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import typer

from devices.errors import CalibrationError, UsageError
from service.cli.options import print_json, remark, show_progress, stderr, stdout

if TYPE_CHECKING:
    from foottile.server import Server
    from service.estimation.calibration import Calibration

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
    from service.cli.calibration_report import calibration_to_json, make_calibration_tables
    from service.estimation.dead_weights import check_and_label_weights
    from service.sessions.calibration_file import parse_calibration
    from storage.durable_files import write_atomically

    weights = check_and_label_weights(request.weights.split(","), request.within_percent)
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
            {**calibration_to_json(calibration), "session": weighing["session_id"], "out": out}
        )
    else:
        remark(f"written: {out}; its recording is session {weighing['session_id']}")


def _select_node(source: Server, name: str | None) -> dict[str, Any]:
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


def _weigh(source: Server, path: str, body: dict[str, Any]) -> dict[str, Any]:
    """Run a guided weighing on the server, print its prompts and return it when done.

    Raises:
        CalibrationError: the weighing ended without a calibration.
    """
    import foottile

    weighing = source.http.send("POST", path, body)
    try:
        weighing = _show_until_done(source, path, weighing)
    finally:  # cancels a running weighing, or closes it on the page
        with suppress(foottile.FootTileError):
            source.http.send("DELETE", path, headers={"If-Match": weighing["session_id"]})
    if weighing["state"] == "failed":
        raise CalibrationError(
            f"no calibration: {weighing['problem']}", where=f"session {weighing['session_id']}"
        )
    return weighing


def _show_until_done(source: Server, path: str, weighing: dict[str, Any]) -> dict[str, Any]:
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


def _assign(source: Server, node: dict[str, Any], calibration: Calibration) -> None:
    path = f"/nodes/{quote(node['node'], safe='')}/calibration"
    source.http.send("PUT", path, {"id": calibration.id})
    remark(f"node {node['node']} now uses it")
