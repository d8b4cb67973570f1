"""`foottile calibrate --live`: dead weights on a tile of a node that is running.

The frames go into a session of the server, in which marks say which weight stood on the tile; the
server fits it, as it fits any bench recording. So the same numbers come out of
`foottile calibrate SESSION` later.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import typer

from devices.errors import CalibrationError, UsageError
from service.cli.options import print_json, progress, remark, stderr, stdout
from service.offline.weighing import Begin, End, Weighing, Withdraw

if TYPE_CHECKING:
    import foottile
    from foottile.server import Server
    from foottile.sessions import Session
    from service.estimation.calibration import Calibration

_LOOK_S = 0.5
_SEAL_S = 300.0
_FIT_S = 600.0
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
    from service.sessions.calibration_file import calibration_of
    from storage.durable import write_whole

    weights = read_weights(asked.weights, asked.within_percent)
    with foottile.connect(server, ca=ca) as source:
        node = _node_of(source, asked.node)
        _check_tiles(node, asked)
        while True:
            session = _weigh(source, node, asked.tiles, weights)
            found = _fit(source, session, asked)
            with source.http.stream(f"/calibrations/{found}") as file:
                content = file.read()
            calibration = calibration_of(content, where=f"calibration {found}")
            if not as_json:
                for table in calibration_tables(calibration):
                    stdout.print(table)
            answer = "y" if asked.yes else _ask()
            if answer != "r":
                break
            _forget(source, found)
        if answer != "y":
            _forget(source, found)
            remark(f"not accepted; its recording is session {session.id}")
            raise typer.Exit(_NOT_ACCEPTED)
        write_whole(out, content)
        if asked.assign:
            _assign(source, node, calibration)
    if as_json:
        print_json({**calibration_json(calibration), "session": session.id, "out": out})
    else:
        remark(f"written: {out}; its recording is session {session.id}")


def read_weights(text: str, within_percent: float) -> list[str]:
    """Return the weights of `200g,500g,1kg`, each with its tolerance, as marks have them.

    Raises:
        UsageError: one of them is no weight.
    """
    from service.estimation.fitting.bench.weights import parse_weight

    found = []
    for part in text.split(","):
        weight = part.strip()
        full = weight if "%" in weight else f"{weight} +-{within_percent:g} %"
        if parse_weight(full) is None:
            raise UsageError(
                f"--weights: {weight!r} is no weight",
                expected="masses or forces with commas between, as 200g,500g,1kg or 4.9N",
            )
        found.append(full)
    return found


def _node_of(source: Server, name: str | None) -> dict[str, Any]:
    if name is not None:
        return source.node(name)
    nodes = [node for node in source.nodes() if node["connected"]]
    if len(nodes) != 1:
        raise UsageError(
            f"{len(nodes)} nodes are connected", expected="one", remedy="Name one: --node NAME"
        )
    return nodes[0]


def _check_tiles(node: dict[str, Any], asked: LiveWeights) -> None:
    """Refuse what would fail after all the weights.

    Raises:
        UsageError: no such tile, or the node cannot use what comes out.
    """
    serials = [tile["serial"] for tile in node["tiles"]]
    bearing = [tile["serial"] for tile in node["tiles"] if not tile["reference"]]
    for tile in asked.tiles:
        if tile not in bearing:
            raise UsageError(
                f"node {node['node']} has no tile {tile}", expected=f"one of {', '.join(serials)}"
            )
    if asked.assign and (left := [serial for serial in bearing if serial not in asked.tiles]):
        raise UsageError(
            f"--assign without tile {', '.join(left)}: a node needs a curve of each of its tiles",
            remedy=f"Calibrate all: --tile {','.join(bearing)}; or put the recordings of single "
            "tiles together with foottile calibrate SESSION...",
        )


def _weigh(
    source: Server, node: dict[str, Any], tiles: Sequence[str], weights: Sequence[str]
) -> Session:
    """Record one pass over the weights on each tile; the session is sealed."""
    from devices.chips.compensation import Compensation
    from storage.schema import array_info

    with (
        source.record(node["node"], f"weights on {', '.join(tiles)}", tags=["calibration"]) as (
            session
        ),
        source.live(node["node"], ["padc", "tadc"], policy="latest") as live,
        progress("waiting for frames") as say,
    ):
        for tile in tiles:
            weighing = Weighing(tile, weights)
            marks: list[foottile.Mark] = []
            shown, shown_s = "", 0.0
            while weighing.step != "done":
                batch = next(live)
                info = array_info(batch.schema, where="the live stream")
                i = info.serials.index(tile)
                kpa = _pressures_kpa(Compensation(info.tiles[i : i + 1]), batch, i)
                for action in weighing.push(1e-9 * np.asarray(batch["t_ns"]), kpa):
                    _mark(source, session, marks, action)
                    _report(weighing, action)
                text = _status(weighing) if stderr.is_terminal else weighing.prompt
                if text != shown and time.monotonic() > shown_s + _LOOK_S:
                    shown, shown_s = text, time.monotonic()
                    say(text)
    with progress("sealing the recording"):
        return session.wait(_SEAL_S)


def _pressures_kpa(compensation: Any, batch: Any, tile: int) -> np.ndarray:
    """Return absolute pressures of one tile, NaN where there is no reading."""
    counts = [
        batch[f"{name}_{tile}"].to_numpy(zero_copy_only=False).astype(np.float64)[:, None]
        for name in ("padc", "tadc")
    ]
    return np.asarray(compensation.kpa(*counts))[:, 0]


def _mark(source: Server, session: Session, marks: list[foottile.Mark], action: object) -> None:
    match action:
        case Begin(label):
            marks.append(session.mark(label))
        case End():
            marks.append(session.mark("end"))
        case Withdraw():
            # The newest step: its beginning, and its end if it has one.
            while marks:
                mark = marks.pop()
                path = f"/sessions/{quote(session.id, safe='')}/events/{mark.id}"
                source.http.send("DELETE", path)
                if mark.label != "end":
                    break


def _report(weighing: Weighing, action: object) -> None:
    seen = weighing.repeatability
    if isinstance(action, Withdraw):
        remark(f"once more: {action.reason}")
    elif isinstance(action, End) and seen is not None and weighing.step != "put on":
        remark(
            f"{weighing.weights[weighing.number - 1]}: {seen.mean_kpa:.2f} kPa, spread "
            f"{seen.spread_kpa:.3f}, settled by {seen.settle_kpa:+.3f}"
        )


def _status(weighing: Weighing) -> str:
    seen = weighing.repeatability
    if seen is None or weighing.step not in ("resting", "holding"):
        return weighing.prompt
    return (
        f"{weighing.prompt} {seen.mean_kpa:.2f} kPa, spread {seen.spread_kpa:.3f}, "
        f"settled by {seen.settle_kpa:+.3f}"
    )


def _fit(source: Server, session: Session, asked: LiveWeights) -> str:
    """Have the server fit it; the id of the calibration.

    Raises:
        CalibrationError: it found none.
    """
    body = {"sessions": [session.id], "name": asked.name, "reference": asked.reference}
    fit = source.http.send("POST", "/calibrations/fits", body)
    end_s = time.monotonic() + _FIT_S
    with progress("fitting"):
        while fit["state"] == "running" and time.monotonic() < end_s:
            time.sleep(_LOOK_S)
            fit = source.http.get(f"/calibrations/fits/{fit['id']}")
    if fit["calibration_id"] is None:
        raise CalibrationError(
            f"no calibration: {fit['problem'] or 'the fit is ' + fit['state']}",
            where=f"session {session.id}",
        )
    return str(fit["calibration_id"])


def _ask() -> str:
    """Return y, r or n; n where nobody answers."""
    try:
        answer = typer.prompt("Accept it? y: yes, r: repeat, n: no", err=True).strip().lower()
    except typer.Abort:
        return "n"
    return answer[:1] if answer[:1] in ("y", "r") else "n"


def _forget(source: Server, calibration_id: str) -> None:
    source.http.send("DELETE", f"/calibrations/{calibration_id}")


def _assign(source: Server, node: dict[str, Any], calibration: Calibration) -> None:
    path = f"/nodes/{quote(node['node'], safe='')}/calibration"
    source.http.send("PUT", path, {"id": calibration.id})
    remark(f"node {node['node']} uses it from now on")
