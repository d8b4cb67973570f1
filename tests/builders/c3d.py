"""C3D files byte by byte, as the C3D manual describes them: parameters, points and analog samples.

Little-endian with numbers in single precision ("Intel", scale below zero).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

BLOCK = 512
_INTEL = 84


def c3d_bytes(
    groups: Mapping[str, Mapping[str, Any]],
    analog: npt.NDArray[np.float64],
    *,
    point_hz: float = 100.0,
    samples_a_frame: int = 10,
    is_integer: bool = False,
    frames_in_header: int | None = None,
    measures_in_header: int | None = None,
) -> bytes:
    """A file with one point and these analog samples.

    Args:
        groups: parameters by group and name: integers, floats or texts, arrays in the order of the
            manual (the first dimension changes fastest).
        analog: (n, channels), n being a multiple of `samples_per_frame`.
        point_hz: frames a second.
        samples_a_frame: analog samples in each.
        is_integer: samples are stored as integers of 16 bits, which they have to be.
        frames_in_header: as the header counts them; None: rightly.
        measures_in_header: analog samples of a frame, likewise.
    """
    parameters = _section(groups)
    frames = len(analog) // samples_a_frame
    begin = 2 + len(parameters) // BLOCK
    channels = analog.shape[1]
    measures = channels * samples_a_frame if measures_in_header is None else measures_in_header
    head = struct.pack(
        "<BB5HfHHf",
        *(2, 0x50, 1, measures, 1),
        *((frames if frames_in_header is None else frames_in_header), 0),
        *(1.0 if is_integer else -1.0, begin, samples_a_frame, point_hz),
    )
    rows = analog.reshape(frames, samples_a_frame * channels)
    points = np.zeros((frames, 4))
    stored = np.concatenate([points, rows], axis=1)
    if is_integer:
        data = stored.astype(np.int64).astype("<u2").tobytes()
    else:
        data = stored.astype("<f4").tobytes()
    return _padded(head) + parameters + _padded(data)


def force_plate(kind: int, channels: int, **more: Any) -> dict[str, dict[str, Any]]:
    """Parameters of one plate of 400 by 200 mm whose corners are those of the laboratory's axes.

    Its z axis points down: corner 1 is where its own x and y are positive (C3D manual,
    FORCE_PLATFORM), so its y is the laboratory's turned.
    """
    corners = np.array([[200, -100, 0], [-200, -100, 0], [-200, 100, 0], [200, 100, 0]], float)
    platform = {
        "USED": 1,
        "TYPE": [kind],
        "ZERO": [1, 0],
        "CORNERS": corners.reshape(1, 4, 3),
        "ORIGIN": np.array([[0.0, 0.0, -40.0]]),
        "CHANNEL": np.arange(1, channels + 1).reshape(1, channels),
    }
    return {
        "POINT": {
            "USED": 1,
            "SCALE": -1.0,
            "RATE": 100.0,
            "DATA_START": 0,
            "FRAMES": 0,
            "LABELS": ["m1"],
            "UNITS": ["mm"],
        },
        "ANALOG": {
            "USED": channels,
            "RATE": 1000.0,
            "LABELS": [f"c{i}" for i in range(channels)],
            "GEN_SCALE": 1.0,
            "SCALE": np.ones(channels),
            "OFFSET": np.zeros(channels, dtype=np.int64),
            "UNITS": ["N"] * 3 + ["Nmm"] * (channels - 3),
        },
        "FORCE_PLATFORM": {**platform, **more},
    }


def two_plates(**more: Any) -> dict[str, dict[str, Any]]:
    """Parameters of two plates of type 2 in one place, with six channels each."""
    corners = force_plate(2, 6)["FORCE_PLATFORM"]["CORNERS"]
    facts = {
        "USED": 2,
        "TYPE": [2, 2],
        "CORNERS": np.repeat(corners, 2, axis=0),
        "ORIGIN": np.array([[0.0, 0.0, -40.0]] * 2),
        "CHANNEL": np.arange(1, 13).reshape(2, 6),
    }
    return force_plate(2, 12, **facts | more)


def _section(groups: Mapping[str, Mapping[str, Any]]) -> bytes:
    content = b""
    for number, (group, parameters) in enumerate(groups.items(), start=1):
        content += struct.pack("<bb", len(group), -number) + group.encode() + b"\x03\0\0"
        for name, value in parameters.items():
            kind, shape, data = _value(value)
            body = struct.pack("<bB", kind, len(shape)) + bytes(shape) + data + b"\0"
            content += struct.pack("<bb", len(name), number) + name.encode()
            content += struct.pack("<H", len(body) + 2) + body
    content += b"\0\0"
    blocks = -(-(len(content) + 4) // BLOCK)
    return _padded(bytes([1, 0x50, blocks, _INTEL]) + content)


def _value(value: Any) -> tuple[int, Sequence[int], bytes]:
    """Type, dimensions with the fastest first, and bytes."""
    if isinstance(value, list) and isinstance(value[0], str):
        width = max(map(len, value))
        return -1, (width, len(value)), "".join(text.ljust(width) for text in value).encode()
    array = np.asarray(value)
    if array.dtype.kind == "i":
        return 2, array.shape[::-1], array.astype("<u2").tobytes()
    return 4, array.shape[::-1], array.astype("<f4").tobytes()


def _padded(content: bytes) -> bytes:
    return content + b"\0" * (-len(content) % BLOCK)
