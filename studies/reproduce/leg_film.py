"""Films of an emulated leg with tags or dots, and a lamp: blur, rolling shutter, noise, codec."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]
_SUPER = 3
"""Pixels of the drawing for one of the picture."""
_TIME_BASE = Fraction(1, 90_000)
LOWER_TAG, UPPER_TAG = 3, 7
_ENCODING = {
    "libx264": {"preset": "veryfast", "crf": "16"},
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8", "crf": "20", "b:v": "0"},
}
"""Options of codecs: fast, and of a camera's quality at any rate."""


@dataclass(frozen=True)
class Camera:
    """Camera.

    Attributes:
        rate_hz: pictures per second.
        exposure: part of the interval in which a picture collects light.
        readout: part of the interval between the first row's exposure and the last one's.
        noise: standard deviation of a pixel, in steps of 1/255.
        codec: of the file.
    """

    rate_hz: float = 50.0
    exposure: float = 0.3
    readout: float = 0.0
    noise: float = 2.0
    codec: str = "libx264"
    width: int = 480
    height: int = 360


def draw_leg(camera: Camera, angle_rad: float, marks: str) -> npt.NDArray[np.float32]:
    """Draw the leg at an angle, in linear steps of 0 to 255."""
    size = camera.height * _SUPER, camera.width * _SUPER
    picture = np.full(size, 110, np.uint8)
    lower = np.array([0.5 * size[1], 0.8 * size[0]])
    length = 0.5 * size[0]
    upper = lower + length * np.array([math.sin(angle_rad), -math.cos(angle_rad)])
    for number, middle in ((LOWER_TAG, lower), (UPPER_TAG, upper)):
        if marks == "dots":
            centre = tuple(round(v * 16) for v in middle)
            cv2.circle(picture, centre, 9 * _SUPER * 16, 255, -1, shift=4)
        elif marks == "tags":
            _draw_tag(picture, number, middle, angle_rad)
    shown = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return shown.astype(np.float32)


def _draw_tag(
    picture: Picture, number: int, middle: npt.NDArray[np.float64], angle_rad: float
) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = cv2.aruco.generateImageMarker(dictionary, number, 120)
    tag = cv2.copyMakeBorder(tag, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=(255,))
    scale = 42.0 * _SUPER / 120.0
    c, s = scale * math.cos(angle_rad), scale * math.sin(angle_rad)
    matrix = np.array([[c, -s, 0.0], [s, c, 0.0]])
    centre, half = (tag.shape[0] - 1) / 2, int(scale * tag.shape[0])
    left, top = (int(v) - half for v in middle)
    matrix[:, 2] = middle - (left, top) - matrix[:, :2] @ np.array([centre, centre])
    part = picture[top : top + 2 * half, left : left + 2 * half]
    shape = part.shape[1], part.shape[0]
    drawn = cv2.warpAffine(tag, matrix, shape, flags=cv2.INTER_AREA)
    mask = cv2.warpAffine(np.full_like(tag, 255), matrix, shape)
    part[mask > 127] = drawn[mask > 127]


def film_leg(
    camera: Camera,
    begin_s: Sequence[float],
    angle_at: Callable[[float], float],
    generator: np.random.Generator,
    *,
    marks: str = "tags",
    lamp_at: Callable[[float, float], float] | None = None,
) -> list[Picture]:
    """Film a leg.

    Motion within an exposure is drawn at three instants; of a rolling shutter at one, and rows in
    twelve bands are exposed one after the other.

    Args:
        camera: the camera.
        begin_s: instants at which the first row's exposure begins.
        angle_at: angle at an instant.
        generator: of the noise.
        marks: `tags` or `dots`.
        lamp_at: mean of a lamp in the corner over an exposure: its middle, and its length.
    """
    exposure_s = camera.exposure / camera.rate_hz
    readout_s = camera.readout / camera.rate_hz
    pictures = []
    for at_s in begin_s:
        bands, parts = (12, (1 / 2,)) if readout_s else (1, (1 / 6, 1 / 2, 5 / 6))
        rows = []
        for band in range(bands):
            delay_s = readout_s * (band + 0.5) / bands
            drawn = np.mean(
                [
                    draw_leg(camera, angle_at(at_s + delay_s + part * exposure_s), marks)
                    for part in parts
                ],
                axis=0,
            )
            high = drawn.shape[0] // bands
            rows.append(drawn[band * high : (band + 1) * high])
        shown = np.concatenate(rows)
        if lamp_at is not None:
            shown[20:32, 20:32] = 60.0 + 180.0 * lamp_at(at_s + exposure_s / 2, exposure_s)
        noisy = shown + generator.normal(0.0, camera.noise, shown.shape)
        pictures.append(np.clip(np.round(noisy), 0, 255).astype(np.uint8))
    return pictures


def write_film(
    path: Path, camera: Camera, pictures: Sequence[Picture], times_s: Sequence[float]
) -> Path:
    """Write pictures with their times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(camera.codec, rate=round(camera.rate_hz))
        assert isinstance(stream, av.VideoStream)  # noqa: S101
        stream.width, stream.height = pictures[0].shape[1], pictures[0].shape[0]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = stream.time_base = _TIME_BASE
        stream.codec_context.options = _ENCODING.get(camera.codec, {})
        for picture, t_s in zip(pictures, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(t_s / _TIME_BASE), _TIME_BASE
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
