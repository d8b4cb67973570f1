"""A film whose pictures have their number in them, beside a session."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from studies.reproduce.leg_film import Camera, Picture, write_film
from tests.service.recording import Recording

PICTURES, RATE_HZ, BITS = 60, 25.0, 6
BLOCK_PX = 40
BEGIN_S = 1.0
"""Of the film, after the session's first frame."""
SHOWN = """() => {
  const film = document.getElementById("film");
  const canvas = new OffscreenCanvas(film.videoWidth, film.videoHeight);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(film, 0, 0);
  let number = 0;
  for (let bit = 0; bit < BITS; bit++) {
    const at = BLOCK * (bit + 0.5);
    number = 2 * number + Number(context.getImageData(at, BLOCK / 2, 1, 1).data[0] > 128);
  }
  return number;
}""".replace("BITS", str(BITS)).replace("BLOCK", str(BLOCK_PX))
"""The number that the film shows."""


def numbered(number: int) -> Picture:
    """A picture with its number in black and white blocks."""
    picture = np.full((180, 320), 90, np.uint8)
    for bit in range(BITS):
        is_white = number >> (BITS - 1 - bit) & 1
        picture[:BLOCK_PX, bit * BLOCK_PX : (bit + 1) * BLOCK_PX] = 255 if is_white else 0
    cv2.circle(picture, (20 + 4 * number, 120), 18, 230, -1)
    return picture


def make_film(path: Path, codec: str) -> Path:
    camera = Camera(rate_hz=RATE_HZ, codec=codec, width=320, height=180)
    pictures = [numbered(number) for number in range(PICTURES)]
    times_s = [number / RATE_HZ for number in range(PICTURES)]
    return write_film(path, camera, pictures, times_s)


TRIMMED: dict[str, tuple[list[tuple[int, int]], list[int]]] = {
    "begin": ([(1200, 13)], [*range(13, 43)]),
    "middle": ([(400, 0), (600, 23)], [*range(10), *range(23, 38)]),
    "end": ([(400, 0)], [*range(10)]),
    "later": ([(500, -1), (2400, 0)], [*range(PICTURES)]),
}
"""Edit lists, for `write_edits`, and the numbers of the pictures that they show."""


def write_edits(path: Path, edits: list[tuple[int, int]]) -> Path:
    """Replace the edit list of an MP4 film, whose index is at the end of the file.

    Args:
        path: the film.
        edits: duration of each, in ms, and its first picture; -1: none, those after it are later.
    """
    content = path.read_bytes()
    delay = struct.unpack_from(">i", content, content.index(b"elst") + 16)[0]  # by B-frames
    ticks = struct.unpack_from(">I", content, content.index(b"mdhd") + 16)[0] / RATE_HZ
    places = [content.index(name) - 4 for name in (b"moov", b"trak", b"edts", b"elst")]
    sizes = [struct.unpack_from(">I", content, at)[0] for at in places]
    new = struct.pack(">4sII", b"elst", 0, len(edits))
    for duration_ms, picture in edits:
        begin = -1 if picture < 0 else delay + round(ticks * picture)
        new += struct.pack(">IiHH", duration_ms, begin, 1, 0)
    after = content[places[-1] + sizes[-1] :]
    head = bytearray(content[: places[-1]] + struct.pack(">I", 4 + len(new)))
    for at, size in zip(places[:-1], sizes[:-1], strict=True):
        struct.pack_into(">I", head, at, size + 4 + len(new) - sizes[-1])
    path.write_bytes(bytes(head) + new + after)
    return path


def added(
    session: Recording, film: Path, *, begin_s: float | None = BEGIN_S, **query: float
) -> dict[str, Any]:
    """A video of the session, aligned or not."""
    http, address = session.running.http, f"{session.url}/videos"
    answer = http.post(address, params={"name": film.name, **query}, content=film.read_bytes())
    assert answer.status_code == 201, answer.text
    video: dict[str, Any] = answer.json()
    return video if begin_s is None else align(session, video, begin_s)


def align(session: Recording, video: dict[str, Any], begin_s: float) -> dict[str, Any]:
    """The video, aligned so that it begins at an instant of the session."""
    t_ns = int(session.column("t_ns")[0]) + round(1e9 * begin_s)
    body = {"method": "hand", "pairs": [{"film_s": 0.0, "t_ns": t_ns, "sigma_ns": 1e6}]}
    address = f"{session.url}/videos/{video['id']}/alignment"
    answer = session.running.http.put(address, json=body)
    assert answer.status_code == 200, answer.text
    aligned: dict[str, Any] = answer.json()
    return aligned
