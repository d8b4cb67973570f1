"""Histories of tares, and the files that older versions wrote."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare, TareSource
from service.sessions.tare_file import RecordedTare
from service.sessions.tares import TareHistory
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
        made.add_tare(tare(t), INFO)
    return made


def as_older(path: Path, change: Callable[[Any], None] = lambda _: None) -> None:
    """The file as it was written before there were hashes, with a change."""
    content = json.loads(path.read_bytes())["tares"]
    for entry in content:
        for name in ("number", "of", "sha256"):
            del entry[name]
    change(content)
    path.write_text(json.dumps(content))


def instants(tares: Sequence[Tare]) -> list[int]:
    return [one.t_ns for one in tares]
