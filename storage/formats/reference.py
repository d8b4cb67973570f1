"""Reader of a reference's force and centre of pressure from any file; units are never guessed.

Columns of the file are mapped to `time_s`, `grf_n`, `cop_x_m` and `cop_y_m`. A column with one of
these names has its unit and sign; for any other column the file or the user states them. The sign
of a force platform is inferred from the load. Implausible values are refused; unusual and dropped
samples are described in `notes`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, UsageError
from storage.formats.readers.parquet import read_sealed_session_table
from storage.formats.readers.registry import read_table, refuse_any_text_options
from storage.formats.readers.table import (
    SOLE_UNITS,
    STANDARD_UNITS,
    ForceTable,
    fit_constant_rate_if_times_repeat,
)
from storage.formats.readers.text import TextOptions

QUANTITIES = ("time_s", "grf_n", "cop_x_m", "cop_y_m")
UNIT_FACTORS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "grf": {"N": 1.0, "kN": 1e3, "mN": 1e-3},
    "cop": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
}
"""Factors to SI units by quantity and unit."""

SIGN_FACTORS: Mapping[str, float] = {"+": 1.0, "-": -1.0}
"""Factors by the stated sign of a force under load."""

PLAUSIBLE_MAX = 1e9
"""Limit of plausible values, in s, N and m."""
TIME_MAX_S = 1e11
"""Limit of times: Unix time in seconds is far below it, and above it in any other unit."""
GAP_MIN_STEPS = 3.5
PEAK_DURATION_S = 0.02
LOAD_RANGE_MIN_SIGMA = 12.0
"""Lowest range of a loaded plate's force, in sigma of its noise."""
PEAK_RATIO_MIN = 3.0
"""Lowest ratio of the peaks of both signs that tells the sign of the load."""
LOAD_FRACTION_MIN = 0.05
"""Load threshold relative to the peak force; below it the centre of pressure is noise."""
REVERSED_RATIO = 2.0
"""Ratio of negative to positive range from which a force counts as negative under load."""


@dataclass(frozen=True)
class ReferenceOptions:
    """Options of the user for reading a reference file.

    Attributes:
        columns: name of the file's column by quantity of `QUANTITIES`; a leading "-" negates it.
        units: units of "time", "grf" and "cop", as in `UNIT_FACTORS`.
        sign: sign of the force under load, "+" or "-".
        rate_hz: sample rate, if the file has no times, or sample numbers instead.
        text: layout of a text file.
        sole_m: length, and width if known, of an insole whose file states fractions, in m.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sign: str | None = None
    rate_hz: float | None = None
    text: TextOptions = field(default_factory=TextOptions)
    sole_m: tuple[float, ...] = ()

    @property
    def source_columns(self) -> set[str]:
        """Names of the mapped columns of the file; for a sum, the sum and its summands."""
        given = {name.removeprefix("-") for name in self.columns.values()}
        return given | {part for name in given for part in _split_summands(name)}

    def __post_init__(self) -> None:
        for name in self.columns:
            if name not in QUANTITIES:
                raise UsageError(f"--map {name}", expected=" or ".join(QUANTITIES))
        for name, unit in self.units.items():
            if name not in UNIT_FACTORS:
                raise UsageError(f"--units {name}", expected=" or ".join(UNIT_FACTORS))
            if unit not in UNIT_FACTORS[name]:
                raise UsageError(f"--units {name}={unit}", expected=" or ".join(UNIT_FACTORS[name]))
        if self.sign is not None and self.sign not in SIGN_FACTORS:
            raise UsageError(f"--sign {self.sign!r}", expected="+ or -, of the force under load")
        if self.rate_hz is not None and not 0.0 < self.rate_hz < PLAUSIBLE_MAX:
            raise UsageError(f"--rate-hz {self.rate_hz:g}", expected="samples a second, above 0")


@dataclass(frozen=True)
class ReferenceData:
    """Reference of n samples in SI units, its force positive under load.

    Attributes:
        where: path of the file.
        time_s: (n,), rising.
        grf_n: (n,), finite.
        cop_m: (n, 2), NaN where unknown; None if the file has no centre of pressure.
        epoch_ns: UTC of time zero; None if the file does not state it.
        notes: remarks for the user.
    """

    where: str
    time_s: Floats
    grf_n: Floats
    cop_m: Floats | None
    epoch_ns: int | None
    notes: tuple[str, ...]


def read_reference(path: Path, options: ReferenceOptions) -> ReferenceData:
    """Read a reference.

    Raises:
        FileFormatError: unreadable, empty, a column is missing, times do not rise, or no sample has
            a force.
        UsageError: neither user nor file states a unit or the sign, or they contradict each other.
    """
    named = options.source_columns
    table = read_sealed_session_table(path, named)
    if table is not None:
        refuse_any_text_options(path, options.text)
    else:
        table = read_table(
            path,
            lambda name: name in named or name.lower() in STANDARD_UNITS,
            text_options=options.text,
        )
    return table_to_reference(table, options)


def table_to_reference(table: ForceTable, options: ReferenceOptions) -> ReferenceData:
    """Return force and centre of pressure of a table, in SI units.

    Raises:
        FileFormatError, UsageError: as for `read_reference`.
    """
    where = table.where
    grf_n = _column_in_si(table, options, "grf_n")
    time_s = _sample_times_s(table, options, len(grf_n))
    grf_n, sign_note = _orient_force(table, options, grf_n, time_s)
    cop = [
        _column_in_si(table, options, name)
        for name in ("cop_x_m", "cop_y_m")
        if name in options.columns or name in table.columns
    ]
    notes = [*table.notes, *sign_note]
    if len(cop) == 1:  # a treadmill, or a line of cells
        has_x = "cop_x_m" in options.columns or "cop_x_m" in table.columns
        nothing = np.full(len(grf_n), np.nan)
        cop = [cop[0], nothing] if has_x else [nothing, cop[0]]
        notes.append(f"the centre of pressure is known along {'x' if has_x else 'y'} only")
    timed = ~np.isnan(time_s)
    if not timed.all():
        notes.append(f"{int((~timed).sum())} of {len(timed)} samples have no time: left out")
        time_s, grf_n, cop = time_s[timed], grf_n[timed], [column[timed] for column in cop]
    if len(time_s) < 2:
        raise FileFormatError(f"{len(time_s)} samples", where=where, expected="at least two")
    time_s, spread_note = fit_constant_rate_if_times_repeat(time_s)
    notes += filter(None, [spread_note])
    _check_time(time_s, where)
    if abs(time_s[0]) >= PLAUSIBLE_MAX:
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
    gaps = steps_s > GAP_MIN_STEPS * np.median(steps_s)
    if gaps.any():
        notes.append(
            f"{int(gaps.sum())} gaps, the longest of {steps_s.max():.3f} s: nothing is compared in "
            "them"
        )
    cop_m = np.stack(cop, axis=1)[known] if cop else None
    if cop_m is not None:
        notes += _drop_far_cop(cop_m, grf_n[known], where)
    return ReferenceData(
        where=where,
        time_s=time_s[known],
        grf_n=grf_n[known],
        cop_m=cop_m,
        epoch_ns=table.epoch_ns,
        notes=tuple(notes),
    )


def _split_summands(name: str) -> list[str]:
    return [part.strip() for part in name.split("+")]


def _sample_times_s(table: ForceTable, options: ReferenceOptions, count: int) -> Floats:
    """Return the times of all samples in s, computed from their numbers if the rate is stated."""
    if options.rate_hz is None:
        return _column_in_si(table, options, "time_s")
    numbers = table.columns.get(options.columns.get("time_s", ""), np.arange(count))
    if not np.array_equal(numbers, np.rint(numbers)):
        raise UsageError(
            f"--rate-hz needs sample numbers, and {options.columns['time_s']!r} has others",
            where=table.where,
            remedy="Leave out --rate-hz, or the time from --map",
        )
    return np.asarray(numbers / options.rate_hz, dtype=np.float64)


def _column_in_si(table: ForceTable, options: ReferenceOptions, name: str) -> Floats:
    """Return a quantity in SI units, with NaN for empty cells.

    Raises:
        FileFormatError: the column is missing, or a time or force is implausibly large.
        UsageError: the unit is not stated, or differs from the file's.
    """
    given = options.columns.get(name, name)
    turned, theirs = given.startswith("-"), given.removeprefix("-")
    parts = [theirs] if theirs in table.columns else _split_summands(theirs)
    if absent := [part for part in parts if part not in table.columns]:
        raise FileFormatError(
            f"no column {absent[0]!r} for {name} (it has "
            f"{', '.join(filter(None, table.names))[:200]})",
            where=table.where,
            expected=table.expected_form,
            remedy=_missing_column_remedy(table, name),
        )
    quantity = name.partition("_")[0]
    factors = dict(UNIT_FACTORS[quantity])
    unit = options.units.get(quantity)
    of_parts = {table.units.get(part) for part in parts}
    of_file = of_parts.pop() if len(of_parts) == 1 else None
    if of_parts:
        raise UsageError(f"the columns of {theirs!r} have different units", where=table.where)
    if of_file in SOLE_UNITS:
        factors[of_file] = _sole_size_m(theirs, of_file, options, table.where)
    if of_file not in factors:
        of_file = None
    if unit is not None and of_file is not None and unit != of_file:
        raise UsageError(
            f"the file states that column {theirs!r} is in {of_file}, not in {unit}",
            where=table.where,
            remedy=f"Leave out --units {quantity}={unit}; if the file is wrong, rename its column",
        )
    unit = of_file or unit or ("s" if quantity == "time" else None)
    if unit is None:
        raise UsageError(
            f"the unit of column {theirs!r} is not stated",
            where=table.where,
            remedy=f"Add --units {quantity}={'|'.join(factors)}",
        )
    total = sum(table.columns[part] for part in parts)
    values = np.asarray(total * factors[unit], dtype=np.float64)
    # Without load a centre of pressure may be arbitrarily large: `_drop_far_cop`.
    greatest = {"time": TIME_MAX_S, "grf": PLAUSIBLE_MAX}.get(quantity)
    if greatest is not None and len(bad := np.flatnonzero(np.abs(values) >= greatest)):
        raise FileFormatError(
            f"column {theirs!r} is {values[bad[0]]:g} at sample {bad[0] + 1}",
            where=table.where,
            expected=f"numbers below {greatest:g}",
            remedy="State its unit, as --units time=ms" if quantity == "time" else "",
        )
    return -values if turned else values


def _missing_column_remedy(table: ForceTable, name: str) -> str:
    """Return the remedy for a quantity without a column."""
    remedies = [f"Name it: --map {name}=COLUMN"]
    if "column1" in table.names and not any(one.endswith("_fz") for one in table.names):
        remedies.append("no line was found that names columns: --skip-rows states where it is")
    if name == "time_s":
        remedies.append("or, without times, state --rate-hz")
    if not "".join(table.names).isascii():
        remedies.append("if names are garbled, state --encoding")
    return "; ".join(remedies)


def _sole_size_m(column: str, unit: str, options: ReferenceOptions, where: str) -> float:
    """Return the length or width of an insole, in m.

    Raises:
        UsageError: it is not stated.
    """
    axis = SOLE_UNITS.index(unit)
    if axis >= len(options.sole_m):
        raise UsageError(
            f"column {column!r} is in {unit}, and the file does not state how long they are",
            where=where,
            remedy=f"Add --sole-m {('LENGTH', 'LENGTH,WIDTH')[axis]}, of the insole in metres",
        )
    return options.sole_m[axis]


def _orient_force(
    table: ForceTable, options: ReferenceOptions, grf_n: Floats, time_s: Floats
) -> tuple[Floats, tuple[str, ...]]:
    """Return the force, positive under load, and a note about how its sign was found."""
    name = options.columns.get("grf_n", "grf_n")
    if options.sign is not None:
        return SIGN_FACTORS[options.sign] * grf_n, ()
    bare = name.removeprefix("-")
    parts = {bare} if bare in table.columns else set(_split_summands(bare))
    if parts <= table.positive_forces:
        return grf_n, ()
    if parts <= table.plate_forces:  # the user's "-" states the sign
        return (grf_n, ()) if name != bare else _orient_force_by_load(grf_n, time_s, table.where)
    raise UsageError(
        f"the sign of column {name!r} is not stated",
        where=table.where,
        remedy="Add --sign + if it is positive under load, --sign - if it is negative",
    )


def _orient_force_by_load(
    grf_n: Floats, time_s: Floats, where: str
) -> tuple[Floats, tuple[str, ...]]:
    """Return the force of a plate, positive under load: a plate pushes and never pulls.

    A peak is exceeded for `PEAK_DURATION_S` in total, so that a spike does not count.

    Raises:
        UsageError: the load is too small, or peaks of both signs are similar.
    """
    known = np.sort(grf_n[np.isfinite(grf_n)])
    if len(known) < 2:
        return grf_n, ()
    step_s = float(np.median(np.diff(time_s)))
    rank = min(len(known) - 1, max(1, round(PEAK_DURATION_S / step_s)) if step_s > 0.0 else 1)
    low_n, high_n = min(0.0, float(known[rank - 1])), max(0.0, float(known[-rank]))
    small_n, great_n = sorted((-low_n, high_n))
    middle_n = float(np.median(known))
    # Third differences are mostly noise: a load changes little in three samples.
    third_n = np.diff(grf_n[np.isfinite(grf_n)], 3)
    noise_n = 1.4826 * float(np.median(np.abs(third_n))) / np.sqrt(20.0) if len(third_n) else 0.0
    is_loaded = float(known[-rank] - known[rank - 1]) > LOAD_RANGE_MIN_SIGMA * noise_n
    if not is_loaded or great_n < PEAK_RATIO_MIN * small_n or great_n == 0.0:
        raise UsageError(
            "the load does not tell the sign of the force: it goes from "
            f"{known[0]:.4g} to {known[-1]:.4g} N, and is {middle_n:.4g} N at its median",
            where=where,
            expected="a plate that was loaded clearly",
            remedy="Add --sign + if it is positive under load, --sign - if it is negative",
        )
    if high_n > -low_n:
        note = "the file holds the load on the plate, positive along the plate's z axis (--sign +)"
    else:
        note = (
            "the file holds the reaction on the foot, negative along the plate's z axis (--sign -)"
        )
    return (grf_n if high_n > -low_n else -grf_n), (note,)


def _drop_far_cop(cop_m: Floats, grf_n: Floats, where: str) -> list[str]:
    """Set implausibly far centres of pressure without load to NaN; return a note.

    Raises:
        FileFormatError: a centre of pressure is implausibly far under load.
    """
    far = (np.abs(cop_m) >= PLAUSIBLE_MAX).any(axis=1)
    if not far.any():
        return []
    bears = far & (grf_n > LOAD_FRACTION_MIN * np.max(grf_n))
    if bears.any():
        sample = int(np.flatnonzero(bears)[0])
        raise FileFormatError(
            f"the centre of pressure is {np.nanmax(np.abs(cop_m[sample])):g} m away at sample "
            f"{sample + 1}, under {grf_n[sample]:.4g} N",
            where=where,
            expected=f"numbers below {PLAUSIBLE_MAX:g}",
        )
    cop_m[far] = np.nan
    return [f"in {int(far.sum())} samples without load there is no centre of pressure: left out"]


def _check_time(time_s: Floats, where: str) -> None:
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
    if -low_n > REVERSED_RATIO * abs(high_n) and low_n < 0.0:
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
