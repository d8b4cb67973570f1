"""A film of a few small pictures, made once."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from service.video.worker import describe_film
from storage.sessions.videos import FilmInfo
from studies.reproduce.leg_film import Camera, write_film

PICTURES = 12
RATE_HZ = 50.0


@cache
def short_film(suffix: str = ".mp4", codec: str = "libx264") -> bytes:
    """Bytes of a film in which every picture differs."""
    camera = Camera(rate_hz=RATE_HZ, codec=codec, width=64, height=48)
    noise = np.random.default_rng(1).integers(0, 255, (PICTURES, 48, 64), dtype=np.uint8)
    times_s = [index / RATE_HZ for index in range(PICTURES)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        return write_film(path, camera, list(noise), times_s).read_bytes()


def describe_short_film(
    path: Path, name: str, capture_rate_hz: float | None = None
) -> tuple[FilmInfo, bytes]:
    """Describe the film as its decoder does, which is started once for all tests."""
    assert path.read_bytes() == short_film(), name
    return _describe_once(capture_rate_hz)


@cache
def _describe_once(capture_rate_hz: float | None) -> tuple[FilmInfo, bytes]:
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        file.write(short_film())
        file.flush()
        return describe_film(Path(file.name), "walk.mp4", capture_rate_hz)
