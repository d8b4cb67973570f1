"""Documents and pages have the table of `devices.flags`; FOOTTILE_WRITE_MAP=1 writes it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from enum import IntFlag
from pathlib import Path

import pytest

from devices.flags import (
    ESTIMATE_FLAGS,
    FRAME_FLAGS,
    TILE_FLAGS,
    EstimateFlag,
    FlagText,
    FrameFlag,
    TileFlag,
)

ROOT = Path(__file__).resolve().parents[1]
TABLES: dict[str, tuple[type[IntFlag], Mapping[IntFlag, FlagText]]] = {
    "TILE": (TileFlag, dict(TILE_FLAGS.items())),
    "FRAME": (FrameFlag, dict(FRAME_FLAGS.items())),
    "ESTIMATE": (EstimateFlag, dict(ESTIMATE_FLAGS.items())),
}
TYPE = "/** @type {[bit: number, title: string, severity: string][]} titled, in their order */"
SCRIPT_HEAD = """\
// Written from devices/flags.py; change it there.

"""


def script() -> str:
    text = SCRIPT_HEAD
    for name, (flags, texts) in TABLES.items():
        bits = ", ".join(f"{flag.name}: {flag.value}" for flag in flags)
        text += f"export const {name} = {{ {bits} }};\n"
        text += f"{TYPE}\n"
        text += f"export const {name}_FLAGS = [\n"
        for flag, each in texts.items():
            if each.title:
                row = json.dumps([flag.value, each.title, str(each.severity)])
                text += f"  {row},\n"
        text += "];\n"
    return text


def table(name: str) -> str:
    flags, texts = TABLES[name]
    return "".join(f"| {f.value} | {str(f.name).lower()} | {texts[f].meaning} |\n" for f in flags)


def written(path: Path, found: str, made: str) -> str:
    if "FOOTTILE_WRITE_MAP" in os.environ:
        path.write_text(path.read_text("utf-8").replace(found, made) if found else made, "utf-8")
        return made
    return found or path.read_text("utf-8")


@pytest.mark.parametrize("name", TABLES)
def test_every_flag_has_its_texts(name: str) -> None:
    flags, texts = TABLES[name]
    assert set(texts) == set(flags)


def test_a_tile_whose_pressure_is_unknown_is_one_that_is_not_used() -> None:
    unknown = [flag for flag, text in TILE_FLAGS.items() if text.severity == "unknown"]
    assert sum(unknown) == TileFlag.UNUSABLE


def test_the_pages_have_bits_and_titles_of_the_table() -> None:
    assert written(ROOT / "web/common/flags.js", "", script()) == script()


@pytest.mark.parametrize(
    ("document", "name", "column"),
    [
        ("docs/acquisition.md", "TILE", "tile_flags"),
        ("docs/formats.md", "ESTIMATE", "estimate_flags"),
    ],
)
def test_the_documents_have_the_meanings_of_the_table(
    document: str, name: str, column: str
) -> None:
    head = f"| bit | of `{column}` | meaning |\n|---|---|---|\n"
    path = ROOT / document
    found = re.search(re.escape(head) + r"((?:\|.*\n)*)", path.read_text("utf-8"))
    assert found is not None
    assert written(path, found[0], head + table(name)) == head + table(name)
