"""The page's files over HTTP: compressed for who takes that, and asked for again for nothing."""

from __future__ import annotations

import gzip
import os
import shutil
from pathlib import Path

import httpx
import pytest

import service.api.app
from service.api.app import find_page_folder
from service.api.static_files import accepts_gzip
from tests.service.running import Running, ServeWith

PLAIN = {"Accept-Encoding": "identity"}
GZIP = {"Accept-Encoding": "gzip, br"}


def get(running: Running, path: str, **headers: str) -> httpx.Response:
    return running.http.get(running.url + path, headers=headers)


def test_a_file_is_the_same_compressed_and_as_it_is(running: Running) -> None:
    for path in sorted(find_page_folder().rglob("*.*")):
        address = f"/static/{path.relative_to(find_page_folder())}"
        plain, packed = get(running, address, **PLAIN), get(running, address, **GZIP)
        assert plain.content == packed.content == path.read_bytes(), address
        assert "content-encoding" not in plain.headers
        assert packed.headers["vary"] == plain.headers["vary"] == "Accept-Encoding"
        assert packed.headers["content-type"] == plain.headers["content-type"]
        if packed.headers.get("content-encoding") == "gzip":
            assert int(packed.headers["content-length"]) < int(plain.headers["content-length"])
            assert packed.headers["etag"] != plain.headers["etag"]


@pytest.mark.parametrize("address", ["/", "/sessions/any", "/static/app.js", "/static/style.css"])
def test_text_goes_compressed_and_once(running: Running, address: str) -> None:
    first = get(running, address, **GZIP)
    assert first.headers["content-encoding"] == "gzip"
    assert first.headers["cache-control"] == "no-cache"
    again = get(running, address, **GZIP, **{"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == first.headers["etag"]
    assert again.headers["vary"] == "Accept-Encoding"
    # The tag of one form is not that of the other: their bytes differ.
    other = get(running, address, **PLAIN, **{"If-None-Match": first.headers["etag"]})
    assert (other.status_code, other.content) == (200, first.content)


def test_a_file_that_was_changed_is_sent_anew(
    serve_with: ServeWith, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "web"
    shutil.copytree(find_page_folder(), folder)
    monkeypatch.setattr(service.api.app, "find_page_folder", lambda: folder)
    running = serve_with()
    first = get(running, "/static/app.js", **GZIP)
    (folder / "app.js").write_text("// another\n" * 20)
    os.utime(folder / "app.js", ns=(1, 1))
    asked = {**GZIP, "If-None-Match": first.headers["etag"]}
    assert get(running, "/static/app.js", **asked).text == "// another\n" * 20


def test_a_head_has_the_headers_of_what_it_asks_for(running: Running) -> None:
    address = f"{running.url}/static/app.js"
    head = running.http.head(address, headers=GZIP)
    assert head.content == b""
    whole = get(running, "/static/app.js", **GZIP)
    for name in ("content-length", "content-encoding", "etag", "content-type"):
        assert head.headers[name] == whole.headers[name]


def test_answers_of_the_api_are_not_compressed(running: Running) -> None:
    for path in ("/openapi.json", "/sessions", "/nodes"):
        answer = running.http.get(path, headers=GZIP)
        assert answer.status_code == 200
        assert "content-encoding" not in answer.headers


def test_what_is_compressed_is_so_to_the_last_bit_each_time(running: Running) -> None:
    with running.http.stream("GET", f"{running.url}/static/app.js", headers=GZIP) as answer:
        sent = b"".join(answer.iter_raw())
    assert gzip.decompress(sent) == (find_page_folder() / "app.js").read_bytes()


@pytest.mark.parametrize(
    ("accepted", "takes"),
    [
        ("gzip", True),
        ("GZIP;q=0.5", True),
        ("br;q=1.0, gzip; q=0.1", True),
        ("", False),
        ("br", False),
        ("gzip;q=0", False),
        ("gzip; q=0.000", False),
        ("*", False),
        ("x-gzip", False),
        ("gzipped", False),
    ],
)
def test_gzip_is_sent_to_who_names_it(accepted: str, takes: bool) -> None:
    assert accepts_gzip(accepted) is takes
