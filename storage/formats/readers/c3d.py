"""Reader of C3D files: parameters, and analog samples in physical units.

Source: C3D user guide (Motion Lab Systems). Numbers are of Intel, DEC or SGI processors. Counts of
frames and samples, and offsets, are read as unsigned. Stated counts are checked against the size of
the file.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.input_files import read_bytes
from storage.formats.readers.table import TEXT_BYTES_MAX

FORM = "a whole C3D file"
BLOCK_BYTES = 512
MAGIC_BYTE = 0x50
INTEL, DEC, SGI = 84, 85, 86
RATE_TOLERANCE = 1e-4
"""Relative difference up to which two rates are equal: above clock error and rounding."""
ParameterValue = npt.NDArray[Any] | list[str]
Parameters = Mapping[str, Mapping[str, ParameterValue]]
RawNumbers = npt.NDArray[Any]


@dataclass(frozen=True)
class C3dFile:
    """Content of a C3D file; samples are scaled on request.

    Attributes:
        where: path of the file.
        parameters: parameters by group and name; the first dimension changes fastest.
        rate_hz: rate of analog samples.
        samples_per_frame: analog samples in a frame of points.
        channel_count: number of analog channels.
        raw: (samples, channels), as stored.
        notes: remarks for the user.
    """

    where: str
    parameters: Parameters
    rate_hz: float
    samples_per_frame: int
    channel_count: int
    raw: RawNumbers
    notes: tuple[str, ...] = ()

    def get_texts_or_empty(self, group: str, name: str) -> list[str]:
        """Return a parameter that is a list of texts; empty if missing or of another type."""
        value = self.parameters.get(group, {}).get(name)
        return value if isinstance(value, list) else []

    def get_numbers_or_empty(self, group: str, name: str) -> RawNumbers:
        """Return a parameter that is an array of numbers; empty if missing or of another type."""
        value = self.parameters.get(group, {}).get(name)
        return np.empty(0) if value is None or isinstance(value, list) else value

    def get_channel_texts(self, parameter_name: str) -> list[str]:
        """Return a text parameter of ANALOG, one a channel; empty where none is stated.

        Channels beyond 255 have theirs in NAME2 and so on.
        """
        more = (f"{parameter_name}{number}" for number in range(2, 2 + self.channel_count // 255))
        texts = [
            text
            for one in (parameter_name, *more)
            for text in self.get_texts_or_empty("ANALOG", one)
        ]
        return texts + [""] * (self.channel_count - len(texts))

    def get_scaled_samples_by_channel(self, channels: Sequence[int]) -> Floats:
        """Return the scaled samples of channels, (len(channels), n), each in its unit.

        Raises:
            FileFormatError: the file states no scale for a channel.
        """
        scale, offset = self._get_channel_numbers("SCALE"), self.get_channel_offsets()
        general = float(np.ravel(self.get_numbers_or_empty("ANALOG", "GEN_SCALE"))[:1].sum() or 1.0)
        at = list(channels)
        if max(at) >= min(len(scale), len(offset)):
            raise FileFormatError(
                f"ANALOG states {len(scale)} scales and {len(offset)} offsets",
                where=self.where,
                expected=f"one of each for each of {self.channel_count} channels",
            )
        raw = self.raw[:, at].T
        if self._is_unsigned():
            raw = raw.view(np.uint16) if raw.dtype.itemsize == 2 else raw
        return np.asarray((raw - offset[at, None]) * (scale[at, None] * general), dtype=np.float64)

    def get_channel_offsets(self) -> Floats:
        """Return the stored value of zero, for each channel."""
        offset = self._get_channel_numbers("OFFSET")
        return offset % 65536 if self._is_unsigned() else offset

    def _is_unsigned(self) -> bool:
        return "".join(self.get_texts_or_empty("ANALOG", "FORMAT")).strip().upper() == "UNSIGNED"

    def _get_channel_numbers(self, name: str) -> Floats:
        more = (f"{name}{number}" for number in range(2, 2 + self.channel_count // 255))
        parts = [np.ravel(self.get_numbers_or_empty("ANALOG", one)) for one in (name, *more)]
        return np.concatenate(parts).astype(np.float64)


def read_c3d(path: Path) -> C3dFile:
    """Read a C3D file.

    Raises:
        FileFormatError: the file cannot be read, is no C3D file, or is truncated.
    """
    where = str(path)
    try:
        content = read_bytes(path, bytes_max=TEXT_BYTES_MAX)
        return _parse_file(content, where)
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error}", where=where, expected=FORM) from error
    except FileFormatError:
        raise
    except (struct.error, IndexError, ValueError, TypeError, OverflowError) as error:
        raise FileFormatError(
            f"its header and its parameters contradict each other: {error}",
            where=where,
            expected=FORM,
        ) from error


def _parse_file(content: bytes, where: str) -> C3dFile:
    if len(content) < BLOCK_BYTES or content[1] != MAGIC_BYTE:
        raise FileFormatError("it is no C3D file", where=where, expected=FORM)
    begin = BLOCK_BYTES * (content[0] - 1)
    processor = content[begin + 3] if 0 < begin < len(content) - 3 else 0
    if processor not in (INTEL, DEC, SGI):
        raise FileFormatError(
            f"its parameters are of processor {processor}",
            where=where,
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
    analog, point = parameters.get("ANALOG", {}), parameters.get("POINT", {})
    channels = _unsigned_count(analog.get("USED"))
    point_hz, analog_hz = (
        _first_number(point.get("RATE")) or frame_hz,
        _first_number(analog.get("RATE")),
    )
    if channels and measures % channels == 0:
        by_rates = analog_hz / point_hz if point_hz > 0.0 else 0.0
        if measures != channels or abs(by_rates - samples_a_frame) > 1e-3:
            samples_a_frame = measures // channels
        # Some programs store the number of channels in place of the samples in a frame.
        measures = channels * samples_a_frame
    elif measures:
        raise FileFormatError(
            f"a frame has {measures} analog samples of {channels} channels",
            where=where,
            expected="the same number of each channel (ANALOG:USED)",
        )
    scale = _first_number(point.get("SCALE")) or scale
    kind = np.dtype(f"{order}f4" if scale < 0.0 else f"{order}i2")
    width = 4 * points + measures
    data = content[BLOCK_BYTES * (data_block - 1) :] if data_block else b""
    frames = _count_frames(parameters, last - first + 1, len(data), width * kind.itemsize, where)
    values = data[: frames * width * kind.itemsize]
    if processor == DEC and scale < 0.0:
        stored: RawNumbers = _parse_floats(values, order, is_dec=True)
    else:
        stored = np.frombuffer(values, kind)
    samples = stored.reshape(frames, width)[:, 4 * points :] if width else np.empty((frames, 0))
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
        where,
        parameters,
        rate_hz if notes or not analog_hz > 0.0 else analog_hz,
        samples_a_frame,
        channels,
        samples.reshape(-1, channels) if channels else np.empty((0, 0)),
        tuple(notes),
    )


def _count_frames(parameters: Parameters, stated: int, size: int, width: int, where: str) -> int:
    """Return the number of frames of `width` bytes.

    The header's count is 65535 at most; longer files state it in one of several parameters.
    """
    if width == 0:
        return 0
    point, trial = parameters.get("POINT", {}), parameters.get("TRIAL", {})
    counts = {
        stated % 65536,
        *(int(_unsigned_count(point.get(name))) for name in ("FRAMES", "LONG_FRAMES")),
    }
    ends = [_join_words(trial.get(f"ACTUAL_{name}_FIELD")) for name in ("START", "END")]
    if all(ends):
        counts.add(ends[1] - ends[0] + 1)
    stored = size // width
    possible = [count for count in counts if 0 < count <= stored]
    if not possible:
        raise FileFormatError(
            f"it ends after {stored} frames of {max(counts)}", where=where, expected=FORM
        )
    # 65535 may mean that the count does not fit.
    return stored if max(possible) == 65535 else max(possible)


def _unsigned_count(value: ParameterValue | None) -> int:
    """Return a count; a negative 16-bit integer is read as unsigned."""
    number = _first_number(value)
    return int(number) % 65536 if -32768 <= number < 0 else max(0, int(number))


def _join_words(value: ParameterValue | None) -> int:
    """Return a number stored as two unsigned words of 16 bits, the lower word first."""
    if value is None or isinstance(value, list) or np.size(value) == 0:
        return 0
    words = [int(word) % 65536 for word in np.ravel(value)[:2]]
    return words[0] + 65536 * (words[1] if len(words) > 1 else 0)


def _first_number(value: ParameterValue | None) -> float:
    """Return the first number of a parameter; 0 if it is missing or not finite."""
    if value is None or isinstance(value, list) or np.size(value) == 0:
        return 0.0
    number = float(np.ravel(value)[0])
    return number if np.isfinite(number) else 0.0


def _parse_parameters(
    content: bytes, at: int, order: str, *, is_dec: bool
) -> dict[str, dict[str, ParameterValue]]:
    """Return all parameters by group and name; a group's name may follow its parameters."""
    names: dict[int, str] = {}
    found: list[tuple[int, str, ParameterValue]] = []
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
    by_group: dict[str, dict[str, ParameterValue]] = {}
    for group, name, value in found:
        by_group.setdefault(names.get(group, ""), {})[name] = value
    return by_group


def _parse_value(content: bytes, at: int, order: str, *, is_dec: bool) -> ParameterValue:
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
