"""Files of the pages over HTTP: compressed on request, and sent once."""

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


def test_a_file_is_the_same_with_and_without_compression(shared: Running) -> None:
    for path in sorted(find_page_folder().rglob("*.*")):
        address = f"/static/{path.relative_to(find_page_folder())}"
        plain, packed = get(shared, address, **PLAIN), get(shared, address, **GZIP)
        assert plain.content == packed.content == path.read_bytes(), address
        assert "content-encoding" not in plain.headers
        assert packed.headers["vary"] == plain.headers["vary"] == "Accept-Encoding"
        assert packed.headers["content-type"] == plain.headers["content-type"]
        if packed.headers.get("content-encoding") == "gzip":
            assert int(packed.headers["content-length"]) < int(plain.headers["content-length"])
            assert packed.headers["etag"] != plain.headers["etag"]


@pytest.mark.parametrize("address", ["/", "/sessions/any", "/static/app.js", "/static/style.css"])
def test_text_is_compressed_and_sent_once(shared: Running, address: str) -> None:
    first = get(shared, address, **GZIP)
    assert first.headers["content-encoding"] == "gzip"
    assert first.headers["cache-control"] == "no-cache"
    again = get(shared, address, **GZIP, **{"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == first.headers["etag"]
    assert again.headers["vary"] == "Accept-Encoding"
    # The other form has other bytes, so it needs a tag of its own.
    other = get(shared, address, **PLAIN, **{"If-None-Match": first.headers["etag"]})
    assert (other.status_code, other.content) == (200, first.content)


def test_a_changed_file_is_sent_again(
    serve_with: ServeWith, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "web"
    shutil.copytree(find_page_folder(), folder)
    monkeypatch.setattr(service.api.app, "find_page_folder", lambda: folder)
    running = serve_with()
    first = get(running, "/static/app.js", **GZIP)
    (folder / "app.js").write_text("// another\n" * 20)
    os.utime(folder / "app.js", ns=(1, 1))
    known = {**GZIP, "If-None-Match": first.headers["etag"]}
    assert get(running, "/static/app.js", **known).text == "// another\n" * 20


@pytest.mark.parametrize("path", ["/openapi.json", "/sessions", "/nodes"])
def test_answers_of_the_api_are_not_compressed(shared: Running, path: str) -> None:
    answer = shared.http.get(path, headers=GZIP)
    assert answer.status_code == 200
    assert "content-encoding" not in answer.headers


def test_head_has_the_headers_of_the_compressed_file(shared: Running) -> None:
    url = f"{shared.url}/static/app.js"
    with shared.http.stream("GET", url, headers=GZIP) as whole:
        assert gzip.decompress(b"".join(whole.iter_raw())) == (
            (find_page_folder() / "app.js").read_bytes()
        )
    head = shared.http.head(url, headers=GZIP)
    assert head.content == b""
    for name in ("content-length", "content-encoding", "etag", "content-type"):
        assert head.headers[name] == whole.headers[name]


@pytest.mark.parametrize(
    ("accepted", "is_accepted"),
    [
        *[(header, True) for header in ("gzip", "GZIP;q=0.5", "br;q=1.0, gzip; q=0.1")],
        *[(header, False) for header in ("", "br", "gzip;q=0", "gzip; q=0.000", "*", "x-gzip")],
        ("gzipped", False),
    ],
)
def test_gzip_is_sent_where_it_is_named(accepted: str, is_accepted: bool) -> None:
    assert accepts_gzip(accepted) is is_accepted
