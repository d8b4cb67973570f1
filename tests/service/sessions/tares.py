"""Histories of tares, and files of them with other content."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare, TareSource
from service.sessions.tares import RecordedTare, TareHistory
from storage.documents import write_checksummed_json
from tests.builders.arrays import make_array, make_tile
from tests.builders.calibrations import make_tare


def array(*serials: str) -> ArrayInfo:
    return make_array([make_tile(i, serial=serial) for i, serial in enumerate(serials)])


INFO = array("T01", "T02")
OTHERS = (array("T01", "T03"), array("T02", "T01"), array("T01"), array("T01", "T02", "T03"))


def tare(t_ns: int = 0, *, tiles: int = 2, source: TareSource = "unloaded") -> Tare:
    return make_tare(
        tiles,
        baseline_kpa=100.0 + np.arange(tiles) / 3,
        noise_kpa=1 / 7,
        temperature_raw_counts=480.0 + np.arange(tiles) / 7,
        t_ns=t_ns,
        source=source,
    )


def same(one: RecordedTare, other: RecordedTare) -> None:
    assert (one.id, one.serials, one.undone) == (other.id, other.serials, other.undone)
    assert (one.reason, one.chips) == (other.reason, other.chips)
    for f in fields(Tare):
        a, b = getattr(one.tare, f.name), getattr(other.tare, f.name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.tobytes()) == (b.dtype, b.tobytes()), f.name
        else:
            assert (type(a), a) == (type(b), b), f.name


def history(tmp_path: Path, *t_ns: int) -> TareHistory:
    made = TareHistory(tmp_path / "node" / "tares.json")
    for t in t_ns:
        made.store_tare_in_force(tare(t), INFO)
    return made


def rewrite(path: Path, change: Callable[[Any], None]) -> None:
    """Change the tares of a file, with right hashes."""
    tares, lines = json.loads(path.read_bytes())["tares"], []
    change(tares)
    for entry in tares:
        del entry["sha256"]
        body = json.dumps(entry).encode()[:-1]
        lines.append(body + b', "sha256": "' + hashlib.sha256(body).hexdigest().encode() + b'"}')
    write_checksummed_json(path, b'{"tares": [\n' + b",\n".join(lines) + b"\n]}")


def instants(tares: Sequence[Tare]) -> list[int]:
    return [one.t_ns for one in tares]
