"""The files of an OpenSim export, unpacked."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.csv as pacsv

from storage.formats.export import Export
from storage.formats.writers.opensim import OPENSIM


class Unpacked:
    """The files of an export, and the table of the `.mot` file."""

    def __init__(self, written: Export | bytes, folder: Path) -> None:
        content = written if isinstance(written, bytes) else b"".join(OPENSIM.encode(written))
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            assert file.testzip() is None
            file.extractall(folder)
            self.names = file.namelist()
        self.folder = folder
        self.mot = next(folder.glob("*.mot"))
        head, _, body = self.mot.read_text("ascii").partition("endheader\n")
        self.head = head.splitlines()
        names, *rows = body.splitlines()
        self.table = np.array([row.split("\t") for row in rows], dtype=np.float64)
        self.columns = dict(zip(names.split("\t"), self.table.T, strict=True))
        self.loads = ElementTree.parse(next(folder.glob("*.xml"))).getroot()  # noqa: S314  # ours
        self.filled = pacsv.read_csv(next(folder.glob("*_filled.csv"))).to_pylist()
        self.notes = json.loads(next(folder.glob("*_notes.json")).read_text())

    def tag(self, name: str) -> str | None:
        return next(self.loads.iter(name)).text
