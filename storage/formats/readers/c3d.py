"""Reader of C3D files: parameters, analog samples, and force platforms of types 1 to 4.

Source: C3D user guide (Motion Lab Systems). Numbers are of Intel, DEC or SGI processors. Counts of
frames and samples, and offsets, are read as unsigned. Stated counts are checked against the size of
the file.

A platform's z axis points down, into it (FORCE_PLATFORM). `plate1_fz` is the force along z as
stored: in some files the positive force of the foot on the plate, in most the negative force of the
plate on the foot. `storage.formats.reference` infers the sign from the load. The offset without
load is not subtracted.

Centres of pressure are in the plane of the plate, from the origin of the laboratory. If the
laboratory has z up and the plate lies flat, they are its x and y. If another axis points up, or the
plate is tilted, the laboratory is rotated by the smallest angle until z is the plate's normal.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.input_files import read_bytes
from storage.formats.readers.force_plate import (
    compute_fz_and_local_cop,
    compute_plate_pose,
    correct_cop_for_bending,
    describe_implausible_cop,
    is_cop_in_corner_unit,
    transform_cop_to_laboratory,
)
from storage.formats.readers.table import (
    TEXT_BYTES_MAX,
    ColumnFilter,
    ForceTable,
    PlateSignals,
    check_table_size,
    make_table_of_separate_plates,
)

FORM = "a whole C3D file"
BLOCK_BYTES = 512
MAGIC_BYTE = 0x50
INTEL, DEC, SGI = 84, 85, 86
RATE_TOLERANCE = 1e-4
"""Relative difference up to which two rates are equal: above clock error and rounding."""
_CHANNEL_COUNTS = {1: 6, 2: 6, 3: 8, 4: 6}
"""Number of channels by type."""
_VERTICAL_FORCE_CHANNELS = {1: range(2, 3), 2: range(2, 3), 3: range(4, 8)}
"""Channels of vertical forces by type. Channels of type 4 have any unit, such as volts: the file
does not state the unit of the forces that its matrix computes."""
_POLYNOMIAL_COEFFICIENTS = 12
"""Number of coefficients of a plate's FPCOPPOLY."""
UNSIGNED_OFFSET_MIN = 1000.0
"""Lowest OFFSET of unsigned samples, for which a stored zero means that nothing was recorded."""
CHECKED_PEAK_FORCE_N = 10.0
"""Lowest peak force of a plate whose centre of pressure is checked."""
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCE_UNITS = {"n": "N", "newton": "N", "newtons": "N", "kn": "kN"}
_MOMENT = re.compile(r"(k?N)[ .*·-]?(mm|cm|m)", re.IGNORECASE)
RawNumbers = npt.NDArray[Any]


@dataclass
class _Parameters:
    """Parameters by group and name: texts, or arrays whose first dimension changes fastest."""

    values: dict[tuple[str, str], RawNumbers | list[str]] = field(default_factory=dict)

    def get_texts_or_empty(self, group: str, name: str) -> list[str]:
        """Return a parameter that is a list of texts; empty if missing or of another type."""
        value = self.values.get((group, name))
        return value if isinstance(value, list) else []

    def get_keyword_or_empty(self, group: str, name: str) -> str:
        """Return a text parameter in upper case, without blanks around it."""
        return "".join(self.get_texts_or_empty(group, name)).strip().upper()

    def get_numbers_or_empty(self, group: str, name: str) -> RawNumbers:
        """Return a parameter that is an array of numbers; empty if missing or of another type."""
        value = self.values.get((group, name))
        return np.empty(0) if value is None or isinstance(value, list) else value

    def get_number_or_zero(self, group: str, name: str) -> float:
        """Return the first number of a parameter; 0 if it is missing or not finite."""
        numbers = np.ravel(self.get_numbers_or_empty(group, name))[:1].astype(np.float64)
        return float(numbers[np.isfinite(numbers)].sum())

    def get_count_or_zero(self, group: str, name: str) -> int:
        """Return a count; a negative 16-bit integer is read as unsigned."""
        number = self.get_number_or_zero(group, name)
        return int(number) % 65536 if -32768 <= number < 0 else max(0, int(number))

    def get_two_words_or_zero(self, group: str, name: str) -> int:
        """Return a number stored as two unsigned words of 16 bits, the lower word first."""
        words = np.ravel(self.get_numbers_or_empty(group, name))[:2].tolist()
        return sum(int(word) % 65536 << 16 * i for i, word in enumerate(words))


@dataclass(frozen=True)
class C3dFile:
    """Content of a C3D file; samples are scaled on request.

    Attributes:
        parameters: parameters by group and name.
        rate_hz: rate of analog samples.
        samples_per_frame: analog samples in a frame of points.
        raw: (samples, channels), as stored.
        stored_points: (frames, 4 points), x, y, z and validity of each, as stored.
        point_rate_hz: rate of frames.
        point_scale: unit of stored coordinates; below zero: they are not scaled.
        notes: remarks for the user.
    """

    parameters: _Parameters
    rate_hz: float
    samples_per_frame: int
    raw: RawNumbers
    stored_points: RawNumbers
    point_rate_hz: float
    point_scale: float
    notes: tuple[str, ...] = ()

    @property
    def channel_count(self) -> int:
        """Number of analog channels."""
        return int(self.raw.shape[1])

    def get_channel_units(self) -> list[str]:
        """Return the unit of each channel; empty where none is stated."""
        texts = [
            text.strip()
            for name in self._list_channel_parameters("UNITS")
            for text in self.parameters.get_texts_or_empty("ANALOG", name)
        ]
        return texts + [""] * (self.channel_count - len(texts))

    def get_scaled_samples_by_channel(self, channels: Sequence[int]) -> Floats:
        """Return the scaled samples of channels, (len(channels), n), each in its unit.

        Raises:
            FileFormatError: the file states no scale for a channel.
        """
        scale, offset = self._get_channel_numbers("SCALE"), self.get_channel_offsets()
        general = np.ravel(self.parameters.get_numbers_or_empty("ANALOG", "GEN_SCALE"))[:1].sum()
        at = list(channels)
        if max(at) >= min(len(scale), len(offset)):
            raise FileFormatError(
                f"ANALOG states {len(scale)} scales and {len(offset)} offsets",
                expected=f"one of each for each of {self.channel_count} channels",
            )
        raw = self.raw[:, at].T
        if self._is_unsigned():
            raw = raw.view(np.uint16) if raw.dtype.itemsize == 2 else raw
        factor = scale[at, None] * float(general or 1.0)
        return np.asarray((raw - offset[at, None]) * factor, dtype=np.float64)

    def get_channel_offsets(self) -> Floats:
        """Return the stored value of zero, for each channel."""
        offset = self._get_channel_numbers("OFFSET")
        return offset % 65536 if self._is_unsigned() else offset

    def _is_unsigned(self) -> bool:
        return self.parameters.get_keyword_or_empty("ANALOG", "FORMAT") == "UNSIGNED"

    def _get_channel_numbers(self, name: str) -> Floats:
        parts = [
            np.ravel(self.parameters.get_numbers_or_empty("ANALOG", one))
            for one in self._list_channel_parameters(name)
        ]
        return np.concatenate(parts).astype(np.float64)

    def _list_channel_parameters(self, name: str) -> list[str]:
        """Return the parameters with a value for each channel: 255 in NAME, 255 in NAME2 ..."""
        return [name, *(f"{name}{i}" for i in range(2, 2 + self.channel_count // 255))]


def read_c3d_force_platforms(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read force and centre of pressure of each readable plate of a C3D file, at the analog rate.

    Columns are `plate1_fz`, `plate1_cop_x`, `plate1_cop_y` and so on, in the file's units. A
    single plate has the names `grf_n`, `cop_x_m` and `cop_y_m` as well, if the file states units.

    Raises:
        FileFormatError: it is no C3D file, is truncated, or has no readable plate.
        OSError: the file cannot be read.
    """
    with _translate_contradictions():
        file = _parse_file(read_bytes(path, bytes_max=TEXT_BYTES_MAX))
        return _read_force_platforms(file, values_max)


def read_c3d_points(path: Path) -> tuple[float, dict[str, Floats]]:
    """Read the rate in Hz and the points of a C3D file by label, (frames, 3), NaN where hidden.

    Raises:
        FileFormatError: it is no C3D file, is truncated, or states no rate or unit of points.
        OSError: the file cannot be read.
    """
    with _translate_contradictions():
        file = _parse_file(read_bytes(path, bytes_max=TEXT_BYTES_MAX))
        unit = file.parameters.get_keyword_or_empty("POINT", "UNITS").lower()
        if unit not in METRES or not file.point_rate_hz > 0.0:
            raise FileFormatError(
                f"its points are in {unit!r}, at {file.point_rate_hz:g} Hz",
                expected="POINT:UNITS of mm, cm or m, and a rate",
            )
        stored = file.stored_points.reshape(len(file.stored_points), -1, 4).astype(np.float64)
        places = stored[..., :3] * (file.point_scale if file.point_scale > 0.0 else 1.0)
        places[stored[..., 3] < 0] = np.nan
        labels = [
            label.strip()
            for i in range(1, 2 + places.shape[1] // 255)
            for label in file.parameters.get_texts_or_empty("POINT", f"LABELS{i if i > 1 else ''}")
        ]
        return file.point_rate_hz, dict(zip(labels, np.moveaxis(places, 1, 0), strict=False))


@contextmanager
def _translate_contradictions() -> Iterator[None]:
    try:
        yield
    except FileFormatError:
        raise
    except (struct.error, IndexError, ValueError, TypeError, OverflowError) as error:
        raise FileFormatError(
            f"its header and its parameters contradict each other: {error}"
        ) from error


def _read_force_platforms(file: C3dFile, values_max: int) -> ForceTable:
    count = min(file.parameters.get_count_or_zero("FORCE_PLATFORM", "USED"), 255)
    if count == 0:
        raise FileFormatError(
            "there is no force platform in it", expected="FORCE_PLATFORM:USED of 1"
        )
    if not (np.isfinite(file.rate_hz) and file.rate_hz > 0.0):
        raise FileFormatError(f"ANALOG:RATE is {file.rate_hz:g}", expected="a rate above 0")
    plates: list[PlateSignals] = []
    notes = [*file.notes]
    refusal: FileFormatError | None = None
    for number in range(1, count + 1):
        try:
            plates.append(_read_plate(file, number - 1, values_max))
        except FileFormatError as error:
            notes.append(f"plate {number} is not read: {error.what}")
            refusal = refusal or error
    if refusal is not None and not plates:
        raise refusal
    time_s = np.arange(len(plates[0].fz)) / file.rate_hz
    return make_table_of_separate_plates(time_s, plates, [*notes, *_zero_notes(file, plates)])


def _parse_file(content: bytes) -> C3dFile:
    if len(content) < BLOCK_BYTES or content[1] != MAGIC_BYTE:
        raise FileFormatError("it is no C3D file")
    begin = BLOCK_BYTES * (content[0] - 1)
    processor = content[begin + 3] if 0 < begin < len(content) - 3 else 0
    if processor not in (INTEL, DEC, SGI):
        raise FileFormatError(
            f"its parameters are of processor {processor}",
            expected=f"{INTEL} (Intel), {DEC} (DEC) or {SGI} (SGI)",
        )
    order = ">" if processor == SGI else "<"
    parameters = _parse_parameters(content, begin + 4, order, is_dec=processor == DEC)
    points, measures, first, last = struct.unpack_from(f"{order}4H", content, 2)
    data_block, samples_a_frame = struct.unpack_from(f"{order}2H", content, 16)
    scale, frame_hz = (
        float(_parse_floats(content[at : at + 4], order, is_dec=processor == DEC)[0])
        for at in (12, 20)
    )
    channels = parameters.get_count_or_zero("ANALOG", "USED")
    point_hz = parameters.get_number_or_zero("POINT", "RATE") or frame_hz
    analog_hz = parameters.get_number_or_zero("ANALOG", "RATE")
    by_rates = analog_hz / point_hz if point_hz > 0.0 else 0.0
    samples_a_frame = _count_samples_a_frame(measures, channels, samples_a_frame, by_rates)
    measures = channels * samples_a_frame if channels else measures
    scale = parameters.get_number_or_zero("POINT", "SCALE") or scale
    kind = np.dtype(f"{order}f4" if scale < 0.0 else f"{order}i2")
    width = 4 * points + measures
    data = content[BLOCK_BYTES * (data_block - 1) :] if data_block else b""
    frames = _count_frames(parameters, last - first + 1, len(data), width * kind.itemsize)
    values = data[: frames * width * kind.itemsize]
    if processor == DEC and scale < 0.0:
        stored: RawNumbers = _parse_floats(values, order, is_dec=True)
    else:
        stored = np.frombuffer(values, kind)
    rows = stored.reshape(frames, width) if width else np.empty((frames, 0))
    samples = rows[:, 4 * points :]
    samples_a_frame = max(1, samples_a_frame)
    by_frames_hz = point_hz * samples_a_frame
    rate_hz = by_frames_hz if by_frames_hz > 0.0 else analog_hz
    notes = []
    if analog_hz > 0.0 and abs(rate_hz - analog_hz) > RATE_TOLERANCE * rate_hz:
        notes.append(
            f"ANALOG:RATE states {analog_hz:g} Hz, and {samples_a_frame} samples in each frame at "
            f"{point_hz:g} Hz are {rate_hz:g} Hz: this rate is used"
        )
    return C3dFile(
        parameters,
        rate_hz if notes or not analog_hz > 0.0 else analog_hz,
        samples_a_frame,
        samples.reshape(-1, channels) if channels else np.empty((0, 0)),
        rows[:, : 4 * points],
        point_hz,
        scale,
        tuple(notes),
    )


def _count_samples_a_frame(measures: int, channels: int, stated: int, by_rates: float) -> int:
    """Return the number of samples of each channel in a frame.

    Args:
        measures: analog samples in a frame, as stated.
        channels: number of channels.
        stated: samples of a channel in a frame, as stated.
        by_rates: the same by the rates of samples and frames.
    """
    if channels and measures % channels == 0:
        # Some programs store the number of channels in place of the samples in a frame.
        is_channel_count = measures == channels and not abs(by_rates - stated) > 1e-3
        return stated if is_channel_count else measures // channels
    if measures:
        raise FileFormatError(
            f"a frame has {measures} analog samples of {channels} channels",
            expected="the same number of each channel (ANALOG:USED)",
        )
    return stated


def _count_frames(parameters: _Parameters, stated: int, size: int, width: int) -> int:
    """Return the number of frames of `width` bytes.

    The header's count is 65535 at most; longer files state it in one of several parameters.
    """
    if width == 0:
        return 0
    counts = {stated % 65536}
    counts |= {parameters.get_count_or_zero("POINT", name) for name in ("FRAMES", "LONG_FRAMES")}
    begin, end = (
        parameters.get_two_words_or_zero("TRIAL", f"ACTUAL_{name}_FIELD")
        for name in ("START", "END")
    )
    if begin and end:
        counts.add(end - begin + 1)
    stored = size // width
    possible = [count for count in counts if 0 < count <= stored]
    if not possible:
        raise FileFormatError(f"it ends after {stored} frames of {max(counts)}")
    # 65535 may mean that the count does not fit.
    return stored if max(possible) == 65535 else max(possible)


def _parse_parameters(content: bytes, at: int, order: str, *, is_dec: bool) -> _Parameters:
    """Return all parameters by group and name; a group's name may follow its parameters."""
    names: dict[int, str] = {}
    found: list[tuple[int, str, RawNumbers | list[str]]] = []
    while at + 2 <= len(content):
        length, group = struct.unpack_from("bb", content, at)
        length = abs(length)  # below zero: locked
        if length == 0 or group == 0:
            break
        name = content[at + 2 : at + 2 + length].decode("latin-1").strip().upper()
        at += 2 + length
        (further,) = struct.unpack_from(f"{order}H", content, at)
        if group < 0:
            names[-group] = name
        else:
            found.append((group, name, _parse_value(content, at + 2, order, is_dec=is_dec)))
        if further == 0:
            break
        at += further
    return _Parameters({(names.get(group, ""), name): value for group, name, value in found})


def _parse_value(content: bytes, at: int, order: str, *, is_dec: bool) -> RawNumbers | list[str]:
    kind, dimensions = struct.unpack_from("bB", content, at)
    shape = tuple(content[at + 2 : at + 2 + dimensions])
    at += 2 + dimensions
    count = int(np.prod(shape, dtype=np.int64))
    data = content[at : at + count * abs(kind)]
    if kind == -1:
        width = shape[0] if shape else 1
        text = data.decode("latin-1")
        # A text without dimensions is one letter.
        return [text[i : i + width].rstrip(" \0") for i in range(0, len(text), max(1, width))]
    if kind == 4:
        numbers = _parse_floats(data, order, is_dec=is_dec)
    else:
        numbers = np.frombuffer(data, np.dtype(f"{order}i{kind}"))
    return np.asarray(numbers).reshape(shape, order="F")


def _parse_floats(content: bytes, order: str, *, is_dec: bool) -> RawNumbers:
    """Return float32 numbers; DEC's have swapped halves and are four times as large."""
    if not is_dec:
        return np.frombuffer(content, np.dtype(f"{order}f4"))
    words = np.frombuffer(content, "<u2").reshape(-1, 2)[:, ::-1]
    return np.ascontiguousarray(words).view("<f4").ravel() / np.float32(4.0)


def _zero_notes(file: C3dFile, plates: list[PlateSignals]) -> list[str]:
    zero = np.ravel(file.parameters.get_numbers_or_empty("FORCE_PLATFORM", "ZERO"))
    if len(zero) != 2 or not 1 <= zero[0] <= zero[1] < np.inf:
        return []
    first, last = map(int, zero)
    window = slice((first - 1) * file.samples_per_frame, last * file.samples_per_frame)
    read = [plate.fz[window] for plate in plates]
    means = ", ".join(f"{fz.mean():.3f}" for fz in read if len(fz))
    return [
        f"ZERO states frames {first} to {last}, in which plates read {means}: no offset is "
        "subtracted"
    ]


def _read_plate(file: C3dFile, i: int, values_max: int) -> PlateSignals:
    """Compute a plate's force and centre of pressure.

    Raises:
        FileFormatError: the type is not supported, or channels are missing.
    """
    kind, at = _get_plate_type_and_channels(file, i)
    check_table_size(len(file.raw), len(at), values_max)
    channels = file.get_scaled_samples_by_channel(at)
    notes = [*_mask_unrecorded_samples(file, at, channels)]
    stated = file.get_channel_units()
    units = [stated[channel] for channel in at]
    force = _common_unit(
        {_FORCE_UNITS.get(units[z].lower()) for z in _VERTICAL_FORCE_CHANNELS.get(kind, ())}
    )
    position = "".join(file.parameters.get_texts_or_empty("POINT", "UNITS")[:1]).strip().lower()
    length = position if position in METRES else None
    origin = _surface_centre(file, i, kind)
    pose = compute_plate_pose(_plate_parameter(file, "CORNERS", i, (3, 4)))
    factor = 1.0
    if kind == 4:
        channels = _calibration_matrix(file, i) @ channels
    elif kind in (1, 2) and length is not None:
        # Convert levers to the unit of positions and corners.
        lever = _common_unit(
            {_length_unit_of(unit, force if kind == 2 else None) for unit in units[3:5]}
        )
        factor = 1.0 if lever is None else METRES[lever] / METRES[length]
        length = None if lever is None else length
    fz, local = compute_fz_and_local_cop(kind, channels, origin, factor)
    cop = None
    if local is None:
        notes.append("ORIGIN does not state where its sensors are: no centre of pressure")
    elif pose is None:
        notes.append("CORNERS do not state where it is: no centre of pressure")
    else:
        _, other = compute_fz_and_local_cop(kind, channels, origin)
        if factor != 1.0 and other is not None and is_cop_in_corner_unit(fz, local, other, pose):
            local = other
            notes.append(
                f"its {'moments' if kind == 2 else 'places'} are not in {units[3]}, as the file "
                f"states, but in the unit of its corners, {length}: else they were off the plate"
            )
        if kind == 3:
            polynomial = _plate_parameter(file, "FPCOPPOLY", i, (_POLYNOMIAL_COEFFICIENTS,))
            local, note = correct_cop_for_bending(local, polynomial, length)
            notes.append(note)
        peak = np.max(np.abs(fz), initial=0.0, where=np.isfinite(fz))
        if force != "N" or peak >= CHECKED_PEAK_FORCE_N:
            notes += describe_implausible_cop(local, fz, pose)
        cop, note = transform_cop_to_laboratory(local, pose)
        notes.append(note)
    return PlateSignals(f"plate{i + 1}", fz, cop, force, length, notes=tuple(filter(None, notes)))


def _get_plate_type_and_channels(file: C3dFile, i: int) -> tuple[int, list[int]]:
    """Return a plate's type, and the numbers of its channels, from 0.

    Raises:
        FileFormatError: the type is not supported, or channels are missing.
    """
    kinds = np.ravel(file.parameters.get_numbers_or_empty("FORCE_PLATFORM", "TYPE")).tolist()
    kind = kinds[i] if i < len(kinds) else 0
    count = _CHANNEL_COUNTS.get(kind)
    if count is None:
        raise FileFormatError(f"it is of type {kind:g}", expected="force platforms of types 1 to 4")
    table = np.atleast_1d(file.parameters.get_numbers_or_empty("FORCE_PLATFORM", "CHANNEL"))
    table = table.reshape(len(table), table.size // max(len(table), 1))
    stored = table[:count, i : i + 1].ravel()
    numbers = [int(n) % 65536 if np.isfinite(n) else 0 for n in stored]
    if len(numbers) < count or not all(0 < n <= file.channel_count for n in numbers):
        raise FileFormatError(
            f"it has the channels {', '.join(map(str, numbers)) or 'of nothing'}",
            expected=f"{count} of the {file.channel_count} channels of the C3D file",
        )
    return int(kind), [n - 1 for n in numbers]


def _mask_unrecorded_samples(file: C3dFile, at: list[int], channels: Floats) -> Iterator[str]:
    """Set samples to NaN that were not recorded: zero in all channels although OFFSET is not."""
    filled = ~file.raw[:, at].any(axis=1)
    if filled.any() and np.abs(file.get_channel_offsets()[at]).max() >= UNSIGNED_OFFSET_MIN:
        channels[:, filled] = np.nan
        yield f"{int(filled.sum())} of its samples are stored as zeros and were not recorded"


def _common_unit(units: set[str | None]) -> str | None:
    """Return the only unit of a set; None if units differ or one is missing."""
    return units.pop() if len(units) == 1 else None


def _length_unit_of(unit: str, force: str | None) -> str | None:
    """Return the length unit of a moment's or a length's unit; None for another unit."""
    if force is None:
        return unit.lower() if unit.lower() in METRES else None
    match = _MOMENT.fullmatch(unit)
    return match[2].lower() if match and match[1].lower() == force.lower() else None


def _calibration_matrix(file: C3dFile, i: int) -> Floats:
    """Return the calibration matrix of a plate of type 4.

    Raises:
        FileFormatError: the matrix is missing, or has another size.
    """
    value = file.parameters.get_numbers_or_empty("FORCE_PLATFORM", "CAL_MATRIX")
    stored = np.atleast_3d(value.astype(np.float64))
    is_by_row = file.parameters.get_keyword_or_empty("FORCE_PLATFORM", "MATRIX_STORE") == "BYROW"
    is_there = stored.ndim == 3 and stored.shape[:2] == (6, 6) and i < stored.shape[2]
    if not is_there or not np.isfinite(stored[:, :, i]).all():
        raise FileFormatError(
            f"it is of type 4, with a CAL_MATRIX of {' by '.join(map(str, stored.shape))}",
            expected="a matrix of 6 by 6 for each plate",
        )
    return stored[:, :, i].T if is_by_row else stored[:, :, i]


def _plate_parameter(file: C3dFile, name: str, i: int, shape: tuple[int, ...]) -> Floats | None:
    """Return a plate's values of a parameter; None if they are missing."""
    value = file.parameters.get_numbers_or_empty("FORCE_PLATFORM", name).astype(np.float64)
    size = int(np.prod(shape))
    flat = np.ravel(value, order="F")[i * size : (i + 1) * size]
    if len(flat) < size or not np.isfinite(flat).all():
        return None
    return flat.reshape(shape, order="F")


def _surface_centre(file: C3dFile, i: int, kind: int) -> Floats:
    """Return the centre of the surface in the plate's axes; zero if it is not stated.

    z points down and the surface lies above the origin, so its z is negative. Some programs store
    the vector from the centre to the origin. For type 3, x and y are distances from sensor to axis,
    whose sign has no meaning.
    """
    origin = _plate_parameter(file, "ORIGIN", i, (3,))
    if origin is None:
        return np.zeros(3)
    if kind == 3:
        return np.array([abs(origin[0]), abs(origin[1]), -abs(origin[2])])
    return -origin if origin[2] > 0.0 else origin
