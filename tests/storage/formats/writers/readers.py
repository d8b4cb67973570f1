"""What files say, by readers that have nothing of their writers."""

from __future__ import annotations

import csv
import io
import json
import warnings
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyxdf
from mcap.reader import make_reader
from scipy.io import loadmat

from storage.sessions.writer import EXPORT_KEY

Said = Mapping[str, str]
"""Facts of a session by name, in small letters; what is no text is JSON or near to it."""


class C3dFile:
    """A file as the library `c3d` reads it: plain Python, and no part of ezc3d."""

    def __init__(self, content: bytes) -> None:
        import c3d

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there are no points
            self.reader = c3d.Reader(io.BytesIO(content))
            pieces = [analog for _, _, analog in self.reader.read_frames(copy=True)]
        self.analog = np.concatenate(pieces, axis=1)
        self.labels = self.texts("ANALOG:LABELS")

    def texts(self, name: str) -> list[str]:
        """The lines of a parameter."""
        parameter = self.reader.get(name)
        width, *_ = parameter.dimensions
        content = bytes(parameter.bytes).decode("ascii")
        return [content[a : a + width].strip() for a in range(0, len(content), width)]

    def text(self, name: str) -> str:
        """Of what is said of the only session."""
        return " ".join(self.texts(f"FOOTTILE:{name}"))

    def channel(self, name: str) -> Any:
        """Samples."""
        return self.analog[self.labels.index(name)]

    def events(self) -> list[tuple[str, float]]:
        """Labels and seconds."""
        times = self.reader.get("EVENT:TIMES").float_array
        seconds = np.ravel(times).reshape(-1, 2) @ [60.0, 1.0]
        return list(zip(self.texts("EVENT:LABELS"), seconds, strict=True))


def _of_json(facts: Mapping[str, Any]) -> Said:
    return {
        name.lower(): value if isinstance(value, str) else json.dumps(value)
        for name, value in facts.items()
    }


def _parquet(content: bytes) -> list[Said]:
    metadata = pq.read_schema(io.BytesIO(content)).metadata
    assert metadata is not None
    return [_of_json(json.loads(metadata[EXPORT_KEY]))]


def _arrow(content: bytes) -> list[Said]:
    return [_of_json(json.loads(pa.ipc.open_file(content).schema.metadata[EXPORT_KEY]))]


def _csv(content: bytes) -> list[Said]:
    rows = csv.DictReader(io.StringIO(content.decode()))
    return [_of_json(json.loads(next(rows)["about"]))]


def _mcap(content: bytes) -> list[Said]:
    return [record.metadata for record in make_reader(io.BytesIO(content)).iter_metadata()]


def _matlab(content: bytes) -> list[Said]:
    file: Any = io.BytesIO(content)
    found = loadmat(file, simplify_cells=True)
    return [each["about"] for each in found.get("sessions", [found])]


def _xdf(content: bytes) -> list[Said]:
    _, header = pyxdf.load_xdf(io.BytesIO(content))
    info = header["info"]
    sessions = info["sessions"][0]["session"] if "sessions" in info else [info]
    return [{name: texts[0] for name, texts in each.items()} for each in sessions]


def _c3d(content: bytes) -> list[Said]:
    file = C3dFile(content)
    return [
        {key.lower(): " ".join(file.texts(f"{name}:{key}")) for key in group.param_keys()}
        for name, group in sorted(file.reader.group_items())
        if name.startswith("FOOTTILE")
    ]


def _opensim(content: bytes) -> list[Said]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        (name,) = (name for name in file.namelist() if name.endswith("_notes.json"))
        said = json.loads(file.read(name))
    return [_of_json(each) for each in said.get("SESSIONS", [said])]


_READERS: Mapping[str, Callable[[bytes], list[Said]]] = {
    "parquet": _parquet,
    "arrow": _arrow,
    "csv": _csv,
    "mcap": _mcap,
    "mat": _matlab,
    "xdf": _xdf,
    "c3d": _c3d,
    "opensim": _opensim,
}


def said_in(to: str, content: bytes) -> list[Said]:
    """What a file of a format says of each session in it."""
    return _READERS[to](content)
