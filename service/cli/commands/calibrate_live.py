"""`foottile calibrate --live`: dead weights on a tile of a node that is running.

The server guides, records and fits, as for the page `/calibrate`; here its prompts are printed.
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
from service.cli.options import print_json, progress, remark, stderr, stdout

if TYPE_CHECKING:
    from foottile.server import Server
    from service.estimation.calibration import Calibration

_LOOK_S = 0.3
_NOT_ACCEPTED = 3


@dataclass(frozen=True)
class LiveWeights:
    """What to put on which tile; see `foottile calibrate --help`."""

    tiles: tuple[str, ...]
    weights: str
    within_percent: float
    node: str | None
    name: str
    reference: str
    assign: bool
    yes: bool


def calibrate_live(
    out: Path, asked: LiveWeights, server: str, ca: Path | None, *, as_json: bool
) -> None:
    """Guide through the weights, fit, show, and write the calibration if it is accepted.

    Raises:
        UsageError: no such node or tile, or a weight that is none.
        CalibrationError: the weights show no curve.
    """
    import foottile
    from service.cli.calibration_report import calibration_json, calibration_tables
    from service.estimation.dead_weights import make_weight_labels
    from service.sessions.calibration_file import parse_calibration
    from storage.durable_files import write_atomically

    weights = make_weight_labels(asked.weights.split(","), asked.within_percent)
    with foottile.connect(server, ca=ca) as source:
        node = _node_of(source, asked.node)
        _check_assignable(node, asked)
        path = f"/nodes/{quote(node['node'], safe='')}/weighing"
        body = {
            "tiles": list(asked.tiles),
            "weights": list(weights),
            "reference": asked.reference,
            "name": asked.name,
        }
        while True:
            weighing = _weigh(source, path, body)
            found = weighing["result"]["calibration_id"]
            with source.http.stream(f"/calibrations/{found}") as file:
                content = file.read()
            calibration = parse_calibration(content, where=f"calibration {found}")
            if not as_json:
                for table in calibration_tables(calibration):
                    stdout.print(table)
            answer = "y" if asked.yes else _ask()
            if answer == "y":
                break
            source.http.send("DELETE", f"/calibrations/{found}")
            if answer == "n":
                remark(f"not accepted; its recording is session {weighing['session_id']}")
                raise typer.Exit(_NOT_ACCEPTED)
        write_atomically(out, content)
        if asked.assign:
            _assign(source, node, calibration)
    if as_json:
        print_json({**calibration_json(calibration), "session": weighing["session_id"], "out": out})
    else:
        remark(f"written: {out}; its recording is session {weighing['session_id']}")


def _node_of(source: Server, name: str | None) -> dict[str, Any]:
    if name is not None:
        return source.node(name)
    nodes = [node for node in source.nodes() if node["connected"]]
    if len(nodes) != 1:
        raise UsageError(
            f"{len(nodes)} nodes are connected", expected="one", remedy="Name one: --node NAME"
        )
    return nodes[0]


def _check_assignable(node: dict[str, Any], asked: LiveWeights) -> None:
    """Refuse what would fail after all the weights.

    Raises:
        UsageError: the node cannot use what comes out.
    """
    bearing = [tile["serial"] for tile in node["tiles"] if not tile["reference"]]
    if asked.assign and (left := [serial for serial in bearing if serial not in asked.tiles]):
        raise UsageError(
            f"--assign without tile {', '.join(left)}: a node needs a curve of each of its tiles",
            remedy=f"Calibrate all: --tile {','.join(bearing)}; or put the recordings of single "
            "tiles together with foottile calibrate SESSION...",
        )


def _weigh(source: Server, path: str, body: dict[str, Any]) -> dict[str, Any]:
    """Have the server guide through the weights, and say what it says; the weighing once done.

    Raises:
        CalibrationError: it ended without a calibration.
    """
    import foottile

    weighing = source.http.send("POST", path, body)
    try:
        weighing = _follow(source, path, weighing)
    finally:  # cancelled if it is under way; else nobody has to close it on the page
        with suppress(foottile.FootTileError):
            source.http.send("DELETE", path, headers={"If-Match": weighing["session_id"]})
    if weighing["state"] == "failed":
        raise CalibrationError(
            f"no calibration: {weighing['problem']}", where=f"session {weighing['session_id']}"
        )
    return weighing


def _follow(source: Server, path: str, weighing: dict[str, Any]) -> dict[str, Any]:
    """Show how far it is until it ends.

    Raises:
        CalibrationError: somebody has cancelled it.
    """
    shown, warned, held = "", None, 0
    with progress(weighing["prompt"]) as say:
        while weighing["state"] in ("weighing", "fitting"):
            if weighing["warning"] not in (None, warned):
                remark(f"once more: {weighing['warning']}")
            warned = weighing["warning"]
            texts = _held(weighing)
            for text in texts[held:]:
                remark(text)
            held = len(texts)
            text = _status(weighing)
            if text != shown:
                shown = text
                say(text)
            time.sleep(_LOOK_S)
            found = source.http.get(path)["weighing"]
            if found is None or found["session_id"] != weighing["session_id"]:
                raise CalibrationError("somebody has cancelled it on the server")
            weighing = found
    return weighing


def _held(weighing: dict[str, Any]) -> list[str]:
    """Return a line for each weight that is done."""
    return [
        f"{tile['serial']} {weight}: {_in_words(seen)}"
        for tile in weighing["tiles"]
        for weight, seen in zip(weighing["weights"], tile["held"], strict=False)
    ]


def _in_words(seen: dict[str, float]) -> str:
    return (
        f"{seen['mean_kpa']:.2f} kPa, spread {seen['spread_kpa']:.3f}, "
        f"settled by {seen['settle_kpa']:+.3f}"
    )


def _status(weighing: dict[str, Any]) -> str:
    if weighing["state"] == "fitting":
        return "fitting"
    if weighing["left_s"] is None or not stderr.is_terminal:
        return str(weighing["prompt"])
    seen = weighing["repeatability"]
    live = "" if seen is None else f"; {_in_words(seen)}"
    return f"{weighing['prompt']}: {weighing['left_s']:.0f} s{live}"


def _ask() -> str:
    """Return y, r or n; n where nobody answers."""
    try:
        answer = typer.prompt("Accept it? y: yes, r: repeat, n: no", err=True).strip().lower()
    except typer.Abort:
        return "n"
    return answer[:1] if answer[:1] in ("y", "r") else "n"


def _assign(source: Server, node: dict[str, Any], calibration: Calibration) -> None:
    path = f"/nodes/{quote(node['node'], safe='')}/calibration"
    source.http.send("PUT", path, {"id": calibration.id})
    remark(f"node {node['node']} uses it from now on")
