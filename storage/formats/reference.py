"""What a reference has measured, from whatever file it is in; units and sign are never guessed.

A file's own columns are told by a mapping to `time_s`, `grf_n`, `cop_x_m` and `cop_y_m`. A column
that has our name says its unit and sign by that; of any other both have to be stated. What cannot
be a measurement is refused here; what is odd, and what was left out, is said in `notes`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from storage.formats.force_platform import read_force_platforms
from storage.formats.pressure_plate import read_pressure_plate
from storage.formats.reference_tables import (
    Table,
    read_csv,
    read_opensim,
    read_parquet,
    read_session,
)

QUANTITIES = ("time_s", "grf_n", "cop_x_m", "cop_y_m")
FACTORS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "grf": {"N": 1.0, "kN": 1e3, "mN": 1e-3},
    "cop": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
}
"""Of each quantity the units that can be stated, in SI units."""

SIGNS: Mapping[str, float] = {"+": 1.0, "-": -1.0}
"""What a force is under load."""

NUMBER_MAX = 1e9
TIME_MAX_S = 1e11
"""Unix time is far below that in seconds, and beyond it in any other unit."""
GAP_STEPS = 3.5
TURNED = 2.0
"""A force that goes so many times further below zero than above it is negative under load."""


@dataclass(frozen=True)
class Stated:
    """What a user says of a file.

    Attributes:
        columns: of `QUANTITIES` the column's name in the file; "-" before it turns its sign.
        units: of "time", "grf" and "cop", as in `FACTORS`.
        sign: of the force under load, "+" or "-".
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sign: str | None = None

    def __post_init__(self) -> None:
        for name in self.columns:
            if name not in QUANTITIES:
                raise UsageError(f"--map {name}", expected=" or ".join(QUANTITIES))
        for name, unit in self.units.items():
            if name not in FACTORS:
                raise UsageError(f"--units {name}", expected=" or ".join(FACTORS))
            if unit not in FACTORS[name]:
                raise UsageError(f"--units {name}={unit}", expected=" or ".join(FACTORS[name]))
        if self.sign is not None and self.sign not in SIGNS:
            raise UsageError(f"--sign {self.sign!r}", expected="+ or -, of the force under load")


@dataclass(frozen=True)
class ReferenceData:
    """A reference in SI units, its force positive under load; n samples.

    Attributes:
        where: the file.
        time_s: (n,), rising.
        grf_n: (n,), finite.
        cop_m: (n, 2), NaN where it is not stated; None if the file has none.
        epoch_ns: UTC of time zero, if the file knows.
        notes: what a user should know of it.
    """

    where: str
    time_s: Floats
    grf_n: Floats
    cop_m: Floats | None
    epoch_ns: int | None
    notes: tuple[str, ...]


def read_reference(path: Path, stated: Stated) -> ReferenceData:
    """Read a reference.

    Raises:
        FileFormatError: unreadable, empty, a column is missing, times do not rise, or no sample has
            a force.
        UsageError: a unit or the sign is neither stated nor said by the file.
        MissingExtraError: it is a C3D file, and what reads it is not installed.
    """
    table = _table(path, stated)
    where = table.where
    time_s = _column(table, stated, "time_s")
    grf_n = _column(table, stated, "grf_n") * _sign(table, stated)
    cop = [
        _column(table, stated, name)
        for name in ("cop_x_m", "cop_y_m")
        if name in stated.columns or name in table.columns
    ]
    if len(cop) == 1:
        raise UsageError(
            "one coordinate of the centre of pressure only",
            where=where,
            remedy="Map cop_x_m and cop_y_m, or neither",
        )
    if len(time_s) < 2:
        raise FileFormatError(f"{len(time_s)} samples", where=where, expected="at least two")
    _check_time(time_s, where)
    notes = list(table.notes)
    if abs(time_s[0]) >= NUMBER_MAX:
        notes.append(
            f"the reference's time begins at {time_s[0]:.3f} s, as Unix time does: the lag is to "
            "its time since then"
        )
        time_s = time_s - time_s[0]
    known = np.isfinite(grf_n)
    if not known.any():
        raise FileFormatError("no sample has a force", where=where)
    if not known.all():
        notes.append(f"{int((~known).sum())} of {len(known)} samples have no force: left out")
    _check_force(grf_n[known], where)
    steps_s = np.diff(time_s[known])
    gaps = steps_s > GAP_STEPS * np.median(steps_s)
    if gaps.any():
        notes.append(
            f"{int(gaps.sum())} gaps, the longest of {steps_s.max():.3f} s: nothing is compared in "
            "them"
        )
    return ReferenceData(
        where=where,
        time_s=time_s[known],
        grf_n=grf_n[known],
        cop_m=np.stack(cop, axis=1)[known] if cop else None,
        epoch_ns=table.epoch_ns,
        notes=tuple(notes),
    )


def _table(path: Path, stated: Stated) -> Table:
    named = {name.removeprefix("-") for name in stated.columns.values()}
    match path.suffix.lower():
        case ".parquet":
            session = read_session(path, named)
            return session if session is not None else read_parquet(path, named)
        case ".mot" | ".sto":
            return read_opensim(path, named)
        case ".csv" | ".txt" | ".tsv":
            return read_csv(path, named)
        case ".npz":
            return read_pressure_plate(path)
        case ".c3d":
            return read_force_platforms(path)
    raise FileFormatError(
        f"a reference with the ending {path.suffix!r} cannot be read",
        where=str(path),
        expected=".csv, .parquet (also a session), .c3d, .mot, .sto, or .npz of a pressure plate",
    )


def _column(table: Table, stated: Stated, name: str) -> Floats:
    """A quantity in SI units; infinite and monstrous numbers are errors, NaN is not."""
    given = stated.columns.get(name, name)
    turned, theirs = given.startswith("-"), given.removeprefix("-")
    if theirs not in table.columns:
        raise FileFormatError(
            f"no column {theirs!r} for {name} (it has {', '.join(table.names)[:200]})",
            where=table.where,
            expected=table.form,
            remedy=f"Name it: --map {name}=COLUMN",
        )
    quantity = name.partition("_")[0]
    unit = stated.units.get(quantity)
    if unit is None and name != "time_s" and theirs not in table.si:
        raise UsageError(
            f"the unit of column {theirs!r} is not stated",
            where=table.where,
            remedy=f"Add --units {quantity}={'|'.join(FACTORS[quantity])}",
        )
    values = table.columns[theirs] * (FACTORS[quantity][unit] if unit is not None else 1.0)
    greatest = TIME_MAX_S if quantity == "time" else NUMBER_MAX
    bad = np.flatnonzero(np.abs(values) >= greatest)
    if len(bad):
        raise FileFormatError(
            f"column {theirs!r} is {values[bad[0]]:g} at sample {bad[0] + 1}",
            where=table.where,
            expected=f"numbers below {greatest:g}",
            remedy="State its unit, as --units time=ms" if quantity == "time" else "",
        )
    return -values if turned else values


def _sign(table: Table, stated: Stated) -> float:
    if stated.sign is not None:
        return SIGNS[stated.sign]
    if stated.columns.get("grf_n", "grf_n") in table.si:
        return 1.0
    raise UsageError(
        f"the sign of column {stated.columns.get('grf_n', 'grf_n')!r} is not stated",
        where=table.where,
        remedy="Add --sign + if it is positive under load, --sign - if it is negative",
    )


def _check_time(time_s: Floats, where: str) -> None:
    if not np.isfinite(time_s).all():
        sample = int(np.flatnonzero(~np.isfinite(time_s))[0])
        raise FileFormatError(f"no time at sample {sample + 1}", where=where)
    falls = np.flatnonzero(np.diff(time_s) <= 0.0)
    if len(falls):
        i = int(falls[0])
        kind = "is repeated" if time_s[i + 1] == time_s[i] else "runs back"
        raise FileFormatError(
            f"time {kind}: {time_s[i]:.6g} s, then {time_s[i + 1]:.6g} s, at sample {i + 2}",
            where=where,
            expected="times that rise from sample to sample",
        )


def _check_force(grf_n: Floats, where: str) -> None:
    low_n, high_n = float(np.percentile(grf_n, 0.1)), float(np.percentile(grf_n, 99.9))
    if -low_n > TURNED * abs(high_n) and low_n < 0.0:
        raise FileFormatError(
            f"the force is negative under load: {low_n:.4g} to {high_n:.4g} N",
            where=where,
            expected="the force of the ground on the foot, positive under load",
            remedy="Give the other --sign",
        )
    if not np.ptp(grf_n) > 0.0:
        raise FileFormatError(
            f"the force is {grf_n[0]:g} N throughout", where=where, expected="a load"
        )
