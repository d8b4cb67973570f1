"""Short scene files, valid and refused."""

from __future__ import annotations

import pytest

from devices.errors import SceneError
from devices.scene.scene_file import Scene, parse_scene

TILE = """
[[tile]]
serial = "{serial}"
mux = {mux}
channel = {channel}
x_m = {x_m}
y_m = 0
z_m = -0.15
"""


def tile(
    serial: str = "T01", mux: str = "0x70", channel: str = "0", x_m: str = "0.01", more: str = ""
) -> str:
    return TILE.format(serial=serial, mux=mux, channel=channel, x_m=x_m) + more


def scene(head: str = "", tiles: str | None = None, sections: str = "") -> Scene:
    tiles = tile() + tile("T02", channel="1") if tiles is None else tiles
    return parse_scene(f'name = "x"\n{head}\n{tiles}\n{sections}', where="my.toml")


def refused(head: str = "", tiles: str | None = None, sections: str = "") -> str:
    with pytest.raises(SceneError) as caught:
        scene(head, tiles, sections)
    assert caught.value.exit_code == 2
    assert caught.value.where == "my.toml"
    assert caught.value.__cause__ is not None
    return str(caught.value)
