"""Films with edit lists: the server's pictures are the film's, browsers get all of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError
from service.video import edit_list
from service.video.container import iterate_pictures, read_film
from service.video.edit_list import EditList, read_edit_list
from tests.web.session_film import (
    BITS,
    BLOCK_PX,
    PICTURES,
    RATE_HZ,
    TRIMMED,
    make_film,
    write_edits,
)

CODECS = ["libvpx-vp9", "libx264"]


def read_numbers(path: Path, begin: int = 0, end: int | None = None) -> list[int]:
    """The numbers that the film's pictures show."""
    middles = (BLOCK_PX * (np.arange(BITS) + 0.5)).astype(int)
    return [
        int("".join(str(int(level > 128)) for level in picture[BLOCK_PX // 2, middles]), 2)
        for _, picture in iterate_pictures(path, is_grey=True, begin=begin, end=end)
    ]


def make_trimmed(folder: Path, codec: str, edits: list[tuple[int, int]]) -> Path:
    return write_edits(make_film(folder / "film.mp4", codec), edits)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("kind", [*TRIMMED])
def test_a_film_has_the_pictures_that_its_edit_list_shows(
    tmp_path: Path, codec: str, kind: str
) -> None:
    edits, shown = TRIMMED[kind]
    path = make_trimmed(tmp_path, codec, edits)
    film, times_s = read_film(path)
    assert film.picture_count == len(shown)
    np.testing.assert_allclose(times_s, np.arange(len(shown)) / RATE_HZ, atol=1e-3)
    assert read_numbers(path) == shown
    for begin in range(0, len(shown), 3):
        assert read_numbers(path, begin, begin + 2) == shown[begin : begin + 2]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("kind", ["begin", "middle", "end"])
def test_a_patch_shows_all_pictures_of_the_file_in_as_many_bytes(
    tmp_path: Path, codec: str, kind: str
) -> None:
    edits, shown = TRIMMED[kind]
    path = make_trimmed(tmp_path, codec, edits)
    found = read_edit_list(path)
    assert found.hidden_count == PICTURES - len(shown)
    assert found.patch is not None
    assert found.whole_s is not None
    np.testing.assert_allclose(found.whole_s, np.array(shown) / RATE_HZ, atol=1e-3)
    content, new = path.read_bytes(), bytes.fromhex(found.patch.hex)
    patched = content[: found.patch.at] + new + content[found.patch.at + len(new) :]
    assert len(patched) == len(content)
    path.write_bytes(patched)
    assert read_numbers(path) == [*range(PICTURES)]
    assert read_film(path)[1][0] == 0.0
    assert read_edit_list(path) == EditList()


@pytest.mark.parametrize("codec", CODECS)
def test_a_list_that_only_shifts_pictures_is_left(tmp_path: Path, codec: str) -> None:
    assert read_edit_list(make_film(tmp_path / "film.mp4", codec)) == EditList()
    assert read_edit_list(make_trimmed(tmp_path, codec, TRIMMED["later"][0])) == EditList()
    assert read_edit_list(make_film(tmp_path / "film.mkv", codec)) == EditList()


@pytest.mark.parametrize(
    ("edits", "shown"),
    [
        ([(400, 0), (400, 5)], [*range(10), *range(5, 15)]),
        ([(400, 20), (400, 0)], [*range(20, 30), *range(10)]),
    ],
    ids=["twice", "another order"],
)
def test_which_pictures_of_a_rearranged_film_browsers_show_is_unknown(
    tmp_path: Path, edits: list[tuple[int, int]], shown: list[int]
) -> None:
    path = make_trimmed(tmp_path, "libvpx-vp9", edits)
    assert read_numbers(path) == shown
    assert read_edit_list(path) == EditList(hidden_count=None)


def test_a_list_that_is_not_found_leaves_it_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_trimmed(tmp_path, "libvpx-vp9", TRIMMED["begin"][0])
    monkeypatch.setattr(edit_list, "_LIST_BYTES_MAX", 27)
    assert read_edit_list(path) == EditList(hidden_count=None)
    monkeypatch.undo()
    monkeypatch.setattr(edit_list, "_BOXES_MAX", 1)
    assert read_edit_list(path) == EditList(hidden_count=None)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    ("box", "at", "value"), [(b"mdhd", 12, 0), (b"mdhd", 12, 2**32 - 1), (b"stts", 12, 0)]
)
def test_a_film_whose_pictures_are_at_one_instant_is_refused(
    tmp_path: Path, box: bytes, at: int, value: int, codec: str
) -> None:
    """Time scale, and interval of all pictures."""
    path = make_film(tmp_path / "film.mp4", codec)
    content = bytearray(path.read_bytes())
    place = content.index(box) + len(box) + at
    content[place : place + 4] = value.to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=rf"{PICTURES} pictures are shown at 1 instants"):
        read_film(path)
