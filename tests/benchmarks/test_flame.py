"""The flame graph: boxes are as wide as the samples in them, and wrappers are left out."""

from __future__ import annotations

import importlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
MAIN = "<module> (foottile:1);run (asyncio/runners.py:118)"
SAMPLES = f"""\
{MAIN};take (service/server/node.py:9);step (x/y.py) 60
{MAIN};tick (service/server/feed.py);send (uvloop/a.py) 38
other (threading.py) 2
"""


@pytest.fixture
def flame(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("flame")


@pytest.mark.slow
def test_boxes_stand_on_who_called_them_and_are_as_wide_as_their_samples(flame: Any) -> None:
    whole = flame.tree(SAMPLES)
    trunk, _ = whole.calls.values()
    assert (whole.samples, trunk.name, trunk.samples) == (100, "run (asyncio)", 98)
    assert {box.name: box.samples for box in trunk.calls.values()} == {
        "step (x)": 60,  # which is all that `take` does
        "send (uvloop)": 38,
    }


@pytest.mark.parametrize(
    ("frame", "kind"),
    [
        ("Feed.tick (service/server/broadcast/broadcaster.py:60)", "FootTile"),
        ("Protocol.data (websockets/protocol.py)", "libraries"),
        ("Thread.run (threading.py:982)", "Python itself"),
        ("something", "Python itself"),
    ],
)
def test_a_box_tells_whose_code_it_is(flame: Any, frame: str, kind: str) -> None:
    assert flame.named(frame)[1] == kind


def test_the_picture_is_an_svg_that_is_the_same_each_time(flame: Any, tmp_path: Path) -> None:
    (tmp_path / "s.txt").write_text(SAMPLES)
    made = []
    for name in ("one.svg", "two.svg"):
        flame.main([str(tmp_path / "s.txt"), "--title", "Some", "--out", str(tmp_path / name)])
        made.append((tmp_path / name).read_bytes())
    assert made[0] == made[1]
    assert "98 % run" in "".join(ET.fromstring(made[0]).itertext())  # noqa: S314  # our own
