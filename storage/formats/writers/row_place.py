"""Centre of pressure of tiles in one row, for programs that need a point of application.

A row of tiles does not measure the COP across the row: that column is NaN. The file states the
place of the row instead.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from devices.flags import EstimateFlag
from devices.frames import ArrayInfo
from storage.schema import Array

COP = ("cop_x_m", "cop_y_m")
NEEDED = ("grf_n", *COP, "estimate_flags")
"""Columns of a force with its point of application."""


def fill_cop_across_tile_row(columns: Mapping[str, Array], info: ArrayInfo) -> dict[str, Array]:
    """Return the columns, with the place of a row of tiles as the unmeasured COP across it.

    Args:
        columns: `NEEDED` and any others, (n,) each.
        info: the array.
    """
    is_stated = (columns["estimate_flags"] & EstimateFlag.COP_MASKED) == 0
    placed = {
        name: np.where(is_stated & np.isnan(columns[name]), place_m, columns[name])
        for name, place_m in zip(COP, info.row_place_m, strict=True)
        if place_m is not None
    }
    return {**columns, **placed}


def make_tile_row_metadata(info: ArrayInfo) -> dict[str, str]:
    """Return the facts about the row's place for a file; empty for an array without a row."""
    rows = [
        f"{axis} = {1e3 * place_m:g} mm"
        for axis, place_m in zip("xy", info.row_place_m, strict=True)
        if place_m is not None
    ]
    if not rows:
        return {}
    text = f"COP not measured along {' and '.join(row[0] for row in rows)}: tiles in one row"
    return {"ROW": f"{text}; points are at {', '.join(rows)} in the foot frame"}
