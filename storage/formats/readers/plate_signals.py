"""Signals of one or several force plates, load cells or soles, and their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from storage.formats.readers.table import SOLE_FRACTION, SOLE_UNITS, ForceTable


@dataclass(frozen=True)
class PlateSignals:
    """Signals of one plate or sole in the units of the file; n samples.

    Attributes:
        name: prefix of its columns, such as `plate1` or `left`: `plate1_fz`, `plate1_cop_x`.
        fz: (n,), force along the plate's normal.
        cop: (2, n), centre of pressure, NaN where unknown; None if the file has none. Its values
            without load are ignored.
        force_unit: unit of the force; None if the file does not state it.
        length_unit: unit of the centre of pressure, or `SOLE_FRACTION`; None if the file does not
            state it.
        is_positive_under_load: True if the force is positive under load; else the load tells its
            sign.
        notes: remarks for the user.
    """

    name: str
    fz: Floats
    cop: Floats | None
    force_unit: str | None
    length_unit: str | None
    is_positive_under_load: bool = False
    notes: tuple[str, ...] = ()


def make_plate_table(
    where: str, time_s: Floats, plates: Sequence[PlateSignals], notes: Sequence[str] = ()
) -> ForceTable:
    """Return a table of plates; a single plate with units gets the standard names as well."""
    columns: dict[str, Floats] = {}
    units = {"time_s": "s"}
    all_notes = [*notes]
    for plate in plates:
        all_notes += [f"{plate.name}: {note}" for note in plate.notes]
        columns[f"{plate.name}_fz"] = plate.fz
        if plate.force_unit is not None:
            units[f"{plate.name}_fz"] = plate.force_unit
        for axis, cop, part in zip(
            "xy", () if plate.cop is None else plate.cop, SOLE_UNITS, strict=False
        ):
            columns[f"{plate.name}_cop_{axis}"] = np.where(plate.fz == 0.0, np.nan, cop)
            if plate.length_unit is not None:
                units[f"{plate.name}_cop_{axis}"] = (
                    part if plate.length_unit == SOLE_FRACTION else plate.length_unit
                )
    positive = {f"{plate.name}_fz" for plate in plates if plate.is_positive_under_load}
    signed_by_load = {f"{plate.name}_fz" for plate in plates if not plate.is_positive_under_load}
    if len(plates) == 1:
        (plate,) = plates
        for ours, theirs in (("grf_n", "fz"), ("cop_x_m", "cop_x"), ("cop_y_m", "cop_y")):
            found = f"{plate.name}_{theirs}"
            if found in units and units[found] not in SOLE_UNITS:
                columns[ours], units[ours] = columns[found], units[found]
        (positive if plate.is_positive_under_load else signed_by_load).add("grf_n")
    else:
        names = ", ".join(plate.name for plate in plates)
        all_notes.append(f"there are {len(plates)} plates or soles ({names}): --map says which one")
    columns["time_s"] = time_s
    return ForceTable(
        where,
        tuple(columns),
        columns,
        units,
        positive_forces=frozenset(positive),
        plate_forces=frozenset(signed_by_load),
        notes=tuple(all_notes),
    )
