"""Calibration of tiles from the rig: curve, range, quality, and origin.

A calibration states every unit and offset; nothing is assumed (hardware.md 7). Its id is the hash
of its content, so two calibrations of one id are the same calibration.

A rig loads one dome along its axis. On the foot a part of the ground's force may bypass the domes,
and the vertical part of the force through an inclined dome depends on friction: a plate measures
both, tiles do not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from devices.arrays import Floats
from devices.errors import CalibrationError
from devices.frames import ChipRegisters
from devices.types import Count, Identifier, Text
from service.estimation.domes import PAPER_EQUATION_2
from service.estimation.effects import CalibrationPart, Effects, NonNegative, Number, Parameter

GAIN_RANGE = (0.05, 20.0)
"""Range of gains; beyond, the unit or the tile is wrong."""
SHEAR_RANGE = (-3.0, 3.0)
"""Range of shears: friction gives -1 to 1; the rest allows for the uncertainty of a fit."""
_TILES_MAX = 256


class MountCalibration(CalibrationPart):
    """Mount calibration of a foot.

    The vertical force on the foot is the sum of `gain F (1 + shear (1 - cos a))`, with F the force
    on each tile by its rig calibration, and `a` the angle between its axis and the vertical.
    """

    reference: Text
    """Session on the force plate, options and file of the plate's recording, as text."""
    gains: Annotated[dict[Identifier, Parameter], Field(min_length=1, max_length=_TILES_MAX)]
    """Gains by serial: newtons of the ground on the tile's part of the foot for one of the dome."""
    shear: Parameter | None = None
    """Direction of the ground's force. -1: along the axes of the tiles, as without friction; 1:
    vertical, and the tiles read less by the cosine. None: unknown."""

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        least, most = GAIN_RANGE
        for serial, gain in self.gains.items():
            if not least <= gain.value <= most:
                raise ValueError(
                    f"tile {serial} has a gain of {gain.value:g}, not {least} to {most}"
                )
        if self.shear is not None and not SHEAR_RANGE[0] <= self.shear.value <= SHEAR_RANGE[1]:
            raise ValueError(f"a shear of {self.shear.value:g}, not {SHEAR_RANGE[0]} to 3")
        return self


ANY_SERIAL = "*"
UNPROVEN_SUFFIX = ", unproven"
"""Suffix of the name of a calibration that was written or edited by hand."""
EDITED_REMEDY = (
    "It was edited by hand or damaged: calibrate again; or, if the edit is meant, delete its lines "
    '"id" and "check": then it is used, and called unproven'
)
LOOP_HALF_WIDTH_FORCE_N = 1.0
CURVE_MISFIT_HALF_FORCE_N = 0.2
"""Forces at which the loop, and the misfit of the cubic, reach half of their final width; both
are 0 at zero load."""
CUBIC_TERMS = 3
"""Number of coefficients of a cubic without constant term."""
_SHOWN_SERIALS = 4
"""Largest number of tiles of a calibration, which may exceed that of an array."""
_ROWS_MAX = 1000
_Scale = Annotated[float, Field(ge=1e-9, le=1e9)]
_Pressure = Annotated[float, Field(ge=-1e4, le=1e4)]


class TileCalibration(CalibrationPart):
    """Static curve of one tile.

    Force in newtons: `f_offset_n + f_scale_n * poly(u)` with `u = (gauge_kpa - p_offset_kpa) /
    p_scale_kpa` and `poly` from `coefficients`, low to high; with `zero_mode` "subtract_f0" less
    the same at zero gauge pressure.
    """

    serial: Identifier
    p_input: Literal["gauge_kpa", "normalised"]
    p_offset_kpa: _Pressure
    p_scale_kpa: _Scale
    f_offset_n: Number
    f_scale_n: _Scale
    zero_mode: Literal["as_fitted", "subtract_f0"]
    coefficients: tuple[Number, Number, Number, Number]
    range_kpa: tuple[_Pressure, _Pressure]
    """Calibrated gauge pressures; above them force is a lower bound."""
    monotonic: bool
    absolute_scale: Literal["measured", "assumed"]
    covariance: tuple[tuple[Number, ...], ...]
    """Covariance of coefficients 1 to 3, in units of `f_scale_n` squared."""
    relative_misfit: NonNegative
    loop_misfit_n: NonNegative
    """Scatter of a new loading's force about the curve: its variance is the sum of
    (`relative_misfit` F)^2, a gain that differs between loadings, and (`loop_misfit_n`
    `compute_share_of_final_loop_width(F)`)^2, a hysteresis loop that opens at once."""
    r2: Number | None
    rmse_n: Number | None
    cv_rmse_n: Number | None
    """Leave-one-repeat-out error."""
    hysteresis_n: Number | None
    """Largest distance between loading and unloading branch."""
    repeats: Count
    baseline_kpa: Number | None
    """Absolute pressure unloaded, during the calibration."""
    noise_kpa: Number | None
    """Standard deviation of a single reading, unloaded."""
    registers: ChipRegisters | None = None
    """Registers of the chip that was calibrated: a serial can be re-labelled, a chip can not.
    None: for any chip, as a preset is."""
    effects: Effects = Effects()
    """Parameters of the dome beside its static curve."""
    rig: RigFacts | None = None
    """Facts about the slow strokes; None for a preset, and for dead weights."""
    weights: WeightFacts | None = None
    """Dead weights that the curve was fitted to; None: slow strokes, or a preset."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if not self.range_kpa[0] < self.range_kpa[1]:
            raise ValueError(f"range_kpa {self.range_kpa} is empty")
        matrix = np.array(self.covariance)
        if matrix.shape != (CUBIC_TERMS, CUBIC_TERMS):
            raise ValueError(f"covariance is {matrix.shape}, expected {(CUBIC_TERMS, CUBIC_TERMS)}")
        if self.monotonic != is_increasing_cubic(self.coefficients, self.scaled_pressure_range):
            raise ValueError(f"monotonic = {self.monotonic} is not true of the coefficients")
        rubber = self.effects.rubber
        if rubber is not None:
            shape = np.array(rubber.covariance, dtype=object).shape
            if shape != (CUBIC_TERMS, CUBIC_TERMS):
                raise ValueError(
                    f"covariance of rubber is {shape}, expected {(CUBIC_TERMS, CUBIC_TERMS)}"
                )
            if not is_increasing_cubic(rubber.coefficients, self.scaled_pressure_range):
                raise ValueError("the curve beneath rubber does not rise all over its range")
        return self

    @property
    def scaled_pressure_range(self) -> tuple[float, float]:
        """Calibrated range in the polynomial's variable."""
        low, high = ((p - self.p_offset_kpa) / self.p_scale_kpa for p in self.range_kpa)
        return low, high


class Calibration(CalibrationPart):
    """Calibrations of tiles by serial, with their force reference."""

    version: Literal[1] = 1
    name: Identifier
    reference: Text
    """Force sensor, or publication, that defines the scale."""
    date: Identifier
    """Date of the recordings, ISO 8601."""
    tiles: Annotated[tuple[TileCalibration, ...], Field(max_length=_TILES_MAX)]
    refused: Annotated[dict[Identifier, Text], Field(max_length=_TILES_MAX)] = Field(default={})
    """Serials that were loaded too, and the reason for having no curve."""
    mounted: MountCalibration | None = None
    """Mount calibration against a force plate; None: there is none."""

    @property
    def id(self) -> str:
        """Identifier: first 16 hexadecimal digits of the SHA-256 of the content."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]

    def check_serials(self) -> None:
        """Refuse a tile with two entries, or with a curve and a reason for having none.

        Only files are checked: calibrations in sessions were used as they are.

        Raises:
            ValueError: there is one.
        """
        serials = [*(tile.serial for tile in self.tiles), *self.refused]
        for serial in serials:
            if serials.count(serial) > 1:
                raise ValueError(f"tile {serial} has two entries: keep the one to use")

    def find_tile_or_wildcard(self, serial: str) -> TileCalibration | None:
        """Return the entry for a serial, else for any (`*`); None without, as for bare tiles."""
        by_serial = {tile.serial: tile for tile in self.tiles}
        return by_serial.get(serial, by_serial.get(ANY_SERIAL))

    def get_tile_or_wildcard(self, serial: str) -> TileCalibration:
        """Return the entry for a serial, else that for any (`*`).

        Raises:
            CalibrationError: there is none.
        """
        return self.get_tiles_or_wildcard([serial])[0]

    def get_tiles_or_wildcard(self, serials: Sequence[str]) -> list[TileCalibration]:
        """Return the entries for serials, as `get_tile_or_wildcard`.

        Raises:
            CalibrationError: one is missing.
        """
        if problem := self.describe_missing_tiles(serials):
            raise CalibrationError(
                problem,
                where=f"calibration {self.name} ({self.id})",
                remedy="Load these tiles too and fit all recordings with `foottile calibrate`, or "
                "name another calibration with --calibration",
            )
        return [
            found for serial in serials if (found := self.find_tile_or_wildcard(serial)) is not None
        ]

    def describe_missing_tiles(self, serials: Sequence[str]) -> str:
        """Return which tiles it covers and which of the serials it does not; empty: it does all."""
        missing = [serial for serial in serials if self.find_tile_or_wildcard(serial) is None]
        if not missing:
            return ""
        known = _format_serials([tile.serial for tile in self.tiles]) or "nothing"
        text = f"it covers {known}, but not {_format_serials(missing)}"
        refused = [serial for serial in missing if serial in self.refused]
        return text + "".join(
            f"; {serial} was refused: {self.refused[serial]}" for serial in refused
        )

    def find_mount_gain(self, serial: str) -> Parameter | None:
        """Return a tile's gain as mounted, over that in the rig; None: not measured."""
        return None if self.mounted is None else self.mounted.gains.get(serial)

    def has_assumed_scale(self, serials: Sequence[str]) -> bool:
        """Return True if the newtons of any of these tiles rest on an assumption.

        A mount gain is measured with a force plate: it makes the scale of its tile a measured one.

        Raises:
            CalibrationError: a tile is not in it.
        """
        return any(
            tile.absolute_scale == "assumed" and self.find_mount_gain(serial) is None
            for serial, tile in zip(serials, self.get_tiles_or_wildcard(serials), strict=True)
        )

    def to_json(self) -> str:
        """Serialize to the text of a calibration file; its id is checked when read."""
        content = {"id": self.id, **self.model_dump(mode="json")}
        return json.dumps(content, indent=2) + "\n"

    @classmethod
    def from_json_verifying_id(cls, text: str, *, where: str) -> Calibration:
        """Parse a calibration file and check its id; without an id the name gets ", unproven".

        Raises:
            CalibrationError: not JSON, a field is missing or unknown, or the id does not match.
        """
        try:
            content = _parse_object(text)
            stated_id = content.pop("id", None)
            calibration = cls.model_validate(content)
            calibration.check_serials()
        except (ValueError, TypeError) as error:
            detail = error.errors()[0] if isinstance(error, ValidationError) else None
            what = (
                f"{'.'.join(str(part) for part in detail['loc'])}: {detail['msg']}"
                if detail
                else str(error)
            )
            raise CalibrationError(
                f"not a calibration: {what}",
                where=where,
                expected="a file written by `foottile calibrate`",
            ) from error
        if stated_id is None:
            name = calibration.name.removesuffix(UNPROVEN_SUFFIX) + UNPROVEN_SUFFIX
            return calibration.model_copy(update={"name": name})
        if stated_id != calibration.id:
            raise CalibrationError(
                f"its id says {stated_id}, its content is {calibration.id}",
                where=where,
                remedy=EDITED_REMEDY,
            )
        return calibration


def _parse_object(text: str) -> dict[str, Any]:
    content = json.loads(text)
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")  # noqa: TRY004  # as for a text that is no JSON
    return content


def compute_share_of_final_loop_width(force_n: Floats) -> Floats:
    """Return the loop's width at each force, relative to its final width: 0 at 0 N, 0.5 at 1 N."""
    return np.asarray(1.0 - LOOP_HALF_WIDTH_FORCE_N / (np.abs(force_n) + LOOP_HALF_WIDTH_FORCE_N))


def is_increasing_cubic(
    coefficients: Sequence[float], scaled_pressure_range: tuple[float, float]
) -> bool:
    """Return whether the cubic rises all over a range, by its slope at ends and vertex."""
    _, c1, c2, c3 = coefficients
    low, high = scaled_pressure_range
    places = [low, high]
    if c3 != 0.0 and low < (vertex := -c2 / (3 * c3)) < high:
        places.append(vertex)
    return all(c1 + u * (2 * c2 + u * 3 * c3) > 0.0 for u in places)


def make_paper_shape_preset() -> Calibration:
    """Make a preset with the shape of the paper's eq. 2, for any tile, with an assumed scale.

    F = 0.13 p^3 + 0.02354 p^2 + 0.5702 p + 0.1309 has no stated units, and no reading in SI units
    gives the paper's 25 to 35 N at saturation (hardware.md 7). So: p = gauge / 15 kPa, zero at zero
    load, 30 N at full scale. The 25 to 35 N that are possible stand as 10 % uncertainty of scale.
    """
    full_scale = sum(PAPER_EQUATION_2[1:])
    none = tuple(tuple(0.0 for _ in range(CUBIC_TERMS)) for _ in range(CUBIC_TERMS))
    tile = TileCalibration(
        serial=ANY_SERIAL,
        p_input="normalised",
        p_offset_kpa=0.0,
        p_scale_kpa=15.0,
        f_offset_n=0.0,
        f_scale_n=30.0 / full_scale,
        zero_mode="subtract_f0",
        coefficients=PAPER_EQUATION_2,
        range_kpa=(0.0, 15.0),
        monotonic=True,
        absolute_scale="assumed",
        covariance=none,
        relative_misfit=0.1,
        loop_misfit_n=0.0,
        r2=None,
        rmse_n=None,
        cv_rmse_n=None,
        hysteresis_n=None,
        repeats=0,
        baseline_kpa=None,
        noise_kpa=None,
    )
    return Calibration(
        name="paper-eq2-shape",
        reference="Ruppert and Badri-Sproewitz 2020, eq. 2; scale assumed",
        date="2020-05-19",
        tiles=(tile,),
    )


PRESETS = {"paper-eq2-shape": make_paper_shape_preset}


class BandPoint(CalibrationPart):
    """Curve at one pressure, with half widths of its 95 % bands."""

    gauge_kpa: Number
    force_n: Number
    mean_n: NonNegative
    """Half width for the mean curve."""
    new_loading_n: NonNegative
    """Half width for a reading in a single new loading."""


class RigFacts(CalibrationPart):
    """Facts about the slow strokes of a curve's fit."""

    recordings: Annotated[int, Field(ge=1, lt=2**31)]
    """Files with slow strokes of the tile."""
    end_n: Number
    """Reference force where the range ends, mean over repeats."""
    end_absolute_kpa: Number
    """Absolute pressure where the range ends: baseline plus range."""
    spare_kpa: Number
    """Distance from there to the chip's rated end; negative: beyond its rating."""
    ended_by: Literal["load", "chip"]
    """"load": the spindle turned back before the tile saturated; "chip": its reading wrapped or
    stood still."""
    temperature_raw_counts: Number | None
    """Chip's temperature in counts, unloaded; None: not recorded."""
    degc: Number | None
    """Chip's temperature, to a few degrees."""
    r2_of_mean: Number
    """R2 of the cubic to the mean of all repeats and both branches, as in the paper."""
    repeat_gains: Annotated[tuple[Number, ...], Field(max_length=_ROWS_MAX)]
    """Force of each repeat over the curve's."""
    baseline_drift_kpa: NonNegative
    """Largest change of the unloaded pressure between repeats of a file, from the second on."""
    band_95: Annotated[tuple[BandPoint, ...], Field(max_length=_ROWS_MAX)]
    """Bands at ten equal steps from zero to the end of the range."""


class WeightStep(CalibrationPart):
    """Dead weight on a tile, and the tile's settled reading."""

    weight: Identifier
    """Text of the marker: `500 g +-0.5 %`."""
    force_n: Number
    gauge_kpa: Number
    noise_kpa: NonNegative
    """Standard deviation of a reading."""
    settle_kpa: Number
    """Last second of the step less its first."""
    residual_n: Number
    """Force of the curve less that of the weight."""


class WeightFacts(CalibrationPart):
    """Facts about the dead weights of a curve's fit."""

    steps: Annotated[tuple[WeightStep, ...], Field(max_length=_ROWS_MAX)]
    baseline_drift_kpa: NonNegative
    """Largest change of the unloaded pressure since the first rest."""
    scale_sigma: NonNegative
    """Standard uncertainty of the weights' common scale, relative."""
    band_95: Annotated[tuple[BandPoint, ...], Field(max_length=_ROWS_MAX)]
    """Bands at ten equal steps; `new_loading_n` is for an estimate of a settled load."""

    def interpolate_half_width_95_n(self, gauge_kpa: float) -> float:
        """Interpolate the half width of a new loading's 95 % interval; constant beyond the band."""
        grid = [point.gauge_kpa for point in self.band_95]
        return float(np.interp(gauge_kpa, grid, [point.new_loading_n for point in self.band_95]))


def _format_serials(serials: Sequence[str]) -> str:
    shown = ", ".join(serials[:_SHOWN_SERIALS])
    more = len(serials) - _SHOWN_SERIALS
    return f"{shown} and {more} more" if more > 0 else shown
