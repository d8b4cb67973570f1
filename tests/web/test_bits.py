"""The page reads status bits by the names and values that Python gives them."""

from __future__ import annotations

import re
from enum import IntFlag
from pathlib import Path

import pytest

from devices.frames import FrameFlag, TileFlag
from service.estimation.estimates import EstimateFlag

BITS_JS = Path(__file__).resolve().parents[2] / "web" / "common" / "bits.js"


@pytest.mark.parametrize(
    ("name", "bits"), [("TILE", TileFlag), ("ESTIMATE", EstimateFlag), ("FRAME", FrameFlag)]
)
def test_the_page_names_every_status_bit_as_python_does(name: str, bits: type[IntFlag]) -> None:
    found = re.search(rf"export const {name} = \{{([^}}]*)\}}", BITS_JS.read_text("utf-8"))
    assert found is not None
    said = {bit: int(value) for bit, value in re.findall(r"(\w+): (\d+)", found[1])}
    assert said == {bit.name: bit.value for bit in bits}
