"""Scenes in one line, and the file of the smallest one."""

from __future__ import annotations

from typing import Any

from devices.scene.scene_file import Scene

ONE_TILE_FILE = """
name = "one"
calibration = "none"

[[tile]]
serial = "T01"
mux = 0x70
channel = 0
x_m = 0.0
y_m = 0.0
z_m = -0.15
"""


def make_scene(
    plugs: tuple[tuple[int, int], ...] = ((0x70, 0), (0x70, 1), (0x70, 2), (0x70, 3)),
    **sections: Any,
) -> Scene:
    """A scene of tiles T01, T02, ... in a line, 14 mm apart, in the order of `plugs`.

    `plugs` are (mux, channel); the sections are those of a scene file as dicts. Every effect and
    all noise is off unless a section says otherwise, so that a test switches on what it is about.
    """
    quiet = {"noise_kpa": 0.0, "gas": False, "rubber": False, "hysteresis": False}
    middle = (len(plugs) - 1) / 2
    tiles = [
        {
            "serial": f"T{i + 1:02d}",
            "mux": mux,
            "channel": channel,
            "x_m": 0.014 * (i - middle),
            "y_m": 0.0,
            "z_m": -0.15,
        }
        for i, (mux, channel) in enumerate(plugs)
    ]
    emulation = quiet | sections.pop("emulation", {})
    facts = {"name": "test", "tile": tiles, "emulation": emulation} | sections
    return Scene.model_validate(facts)
