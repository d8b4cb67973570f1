"""Edit list of an MP4 film: pictures of the file that it hides, and bytes that show them all.

Browsers do not agree about edit lists: Firefox begins with the file's first picture and ends when
the first edit would, Chromium shows other pictures before a second cut. A page gets the film with
one edit of all pictures in place of the list, which takes as many bytes (ISO 14496-12, 8.6.6), and
the place of each picture among all.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from devices.arrays import Floats
from service.video.container import open_container
from storage.sessions.videos import BytesPatch

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

_BOXES_MAX = 10_000
_LIST_BYTES_MAX = 64 << 10
_HEAD = ">I4sB3xI"
"""Head of an edit list: size of the box, its name, version, number of edits."""
_HEAD_BYTES = struct.calcsize(_HEAD)
_EDITS = ">Ii", ">Qq"
"""Begin of an edit by version: its duration, the movie's ticks; where it begins, the track's."""
_EDIT_BYTES = 12, 20
"""Size of an edit by version: its rate follows, 1 as 16.16 bits."""
_EMPTY = -1
"""Begin of an edit without pictures: those after it are later."""


class EditList(NamedTuple):
    """Effect of an edit list.

    Attributes:
        hidden_count: pictures of the file that it hides; None: it shows pictures twice or in
            another order, or cannot be replaced, and which a browser shows is unknown.
        patch: bytes with which all pictures are shown; None: the film's are all.
        whole_s: with `patch`, time of each picture of the film among all, in s from the file's
            first one.
    """

    hidden_count: int | None = 0
    patch: BytesPatch | None = None
    whole_s: Floats | None = None


class _Box(NamedTuple):
    """Box of a file: its name, and where it, its content and the next box begin."""

    name: bytes
    at: int
    begin: int
    end: int


class _List(NamedTuple):
    """Edit list of a track: its box, where that is in the file, the movie's ticks per second."""

    box: bytes
    at: int
    ticks_per_s: int


class _Packets(NamedTuple):
    """Pictures that are shown: where they are in the file; begin and end of display, in ticks."""

    places: list[int]
    begins: list[int]
    ends: list[int]


def read_edit_list(path: Path) -> EditList:
    """Read the edit list of a film.

    Raises:
        FileFormatError: the file is no film.
    """
    with open_container(path) as (container, stream):
        if "mp4" not in container.format.name:
            return EditList()
        track_id, in_file, tick_s = stream.id, stream.frames, float(stream.time_base or 0)
        shown = _read_packets(container, stream)
    with path.open("rb") as file:
        found = _find_list(file, track_id)
    if (found is None or _count_edits(found.box) <= 1) and len(set(shown.begins)) >= in_file:
        return EditList()  # it shows all, if perhaps later
    with open_container(path, ignore_editlist="1") as (container, stream):
        whole = _read_packets(container, stream)
    first, begin_at = min(whole.begins), dict(zip(whole.places, whole.begins, strict=True))
    place_at = dict(sorted(zip(shown.begins, shown.places, strict=True)))
    whole_s = tick_s * np.array([begin_at.get(each, first) - first for each in place_at.values()])
    if found is None or first < 0 or np.any(np.diff(whole_s) <= 0):
        return EditList(hidden_count=None)
    duration = math.ceil((max(whole.ends) - first) * tick_s * found.ticks_per_s)
    patch = _make_patch(found, first, duration)
    return EditList(len(begin_at) - len(whole_s), patch, whole_s)


def _read_packets(container: InputContainer, stream: VideoStream) -> _Packets:
    found = _Packets([], [], [])
    for packet in container.demux(stream):
        if packet.size and packet.pts is not None and not packet.is_discard:
            found.places.append(packet.pos or 0)
            found.begins.append(packet.pts)
            found.ends.append(packet.pts + (packet.duration or 0))
    return found


def _make_patch(found: _List, begin: int, duration: int) -> BytesPatch:
    """Make one edit of all edits, and a free box of the room that is left."""
    version = found.box[8]
    edit = struct.pack(_EDITS[version], duration, begin) + struct.pack(">HH", 1, 0)
    size = _HEAD_BYTES + len(edit)
    left = len(found.box) - size
    content = struct.pack(_HEAD, size, b"elst", version, 1) + edit
    if left:  # at least one more edit
        content += struct.pack(">I4s", left, b"free") + bytes(left - 8)
    return BytesPatch(at=found.at, hex=content.hex())


def _count_edits(box: bytes) -> int:
    """Count the edits with pictures."""
    _, _, version, count = struct.unpack_from(_HEAD, box)
    begins = (
        struct.unpack_from(_EDITS[version], box, _HEAD_BYTES + number * _EDIT_BYTES[version])[1]
        for number in range(count)
    )
    return sum(begin != _EMPTY for begin in begins)


def _find_list(file: BinaryIO, track_id: int) -> _List | None:
    """Find the edit list of a track; None: it has none that can be read."""
    try:
        (movie,) = _find_boxes(file, b"moov")
        (header,) = _find_boxes(file, b"mvhd", movie)
        for track in _find_boxes(file, b"trak", movie):
            (track_header,) = _find_boxes(file, b"tkhd", track)
            if _read_number(file, track_header) == track_id:
                (edits,) = _find_boxes(file, b"edts", track)
                (place,) = _find_boxes(file, b"elst", edits)
                return _read_list(file, place, _read_number(file, header))
    except (ValueError, LookupError, struct.error):  # other boxes than there have to be
        pass
    return None


def _find_boxes(file: BinaryIO, name: bytes, parent: _Box | None = None) -> list[_Box]:
    """Find the boxes of a name in another one, or in the file."""
    return [box for box in _iterate_boxes(file, parent) if box.name == name]


def _iterate_boxes(file: BinaryIO, parent: _Box | None) -> Iterator[_Box]:
    at, end = (0, file.seek(0, 2)) if parent is None else parent[2:]
    for _ in range(_BOXES_MAX):
        if at + 8 > end:
            return
        file.seek(at)
        size, name = struct.unpack(">I4s", file.read(8))
        begin = at + 8
        if size == 1:
            (size,), begin = struct.unpack(">Q", file.read(8)), at + 16
        elif size == 0:
            size = end - at
        if not begin <= at + size <= end:
            return
        yield _Box(name, at, begin, at + size)
        at += size


def _read_number(file: BinaryIO, box: _Box) -> int:
    """Read the number behind the two times of a header: the track's, or the movie's ticks."""
    file.seek(box.begin)
    content = file.read(24)
    (number,) = struct.unpack_from(">I", content, 20 if content[0] else 12)
    return int(number)


def _read_list(file: BinaryIO, place: _Box, ticks_per_s: int) -> _List:
    """Read an edit list.

    Raises:
        ValueError: it is too long, or has fewer edits than it states.
    """
    file.seek(place.at)
    box = file.read(min(place.end - place.at, _LIST_BYTES_MAX + 1))
    _, _, version, count = struct.unpack_from(_HEAD, box)
    left = len(box) - _HEAD_BYTES - count * _EDIT_BYTES[version]
    if len(box) > _LIST_BYTES_MAX or place.begin != place.at + 8 or not count or left < 0:
        raise ValueError("no edit list")
    return _List(box, place.at, ticks_per_s)
