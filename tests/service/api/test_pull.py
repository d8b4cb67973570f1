"""`foottile pull`: whole sessions that are resumed and repaired, and slices."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

import foottile
from devices.errors import UsageError
from foottile import Client
from service.pull import pull_export, pull_session
from storage.formats.slice import Slice
from storage.formats.writers.registry import get_format
from storage.verify.data_folder import find_verdict, verify_path
from tests.service.api.sealed import Sealed
from tests.service.running import Running
from tests.storage.faulty_disk import flip_bits

UNKNOWN_ID = "20200101T000000Z-000000"


@pytest.fixture
def server(sealed: Sealed) -> Iterator[Client]:
    """A client of the server."""
    with foottile.connect(sealed.running.url) as server:
        yield server


def test_a_pulled_session_has_the_file_and_verified_sidecars(
    server: Client, sealed: Sealed, tmp_path: Path
) -> None:
    assert {each.id for each in server.sessions()} == {sealed.id, sealed.recording.id}
    pulled = pull_session(server, sealed.id, tmp_path)
    assert Path(pulled["path"]).read_bytes() == sealed.content
    assert pulled["resumed_bytes"] == 0
    folder = tmp_path / sealed.id
    assert {path.name for path in folder.iterdir()} == {
        *("frames.parquet", "session.json", "markers.json", "markers.parquet", "ledger.json"),
        *("clock.parquet", "warm_up.parquet", "SHA256SUMS"),
    }
    subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=folder, check=True)
    written_ns = Path(pulled["path"]).stat().st_mtime_ns
    assert pull_session(server, sealed.id, tmp_path)["path"] == pulled["path"]
    assert Path(pulled["path"]).stat().st_mtime_ns == written_ns
    report = verify_path(folder)
    assert (find_verdict(report), report.to_json_dict()["unproven"]) == ("complete", [])
    for path in sorted(folder.iterdir()):
        whole = path.read_bytes()
        flip_bits(path, 40)
        assert path.name in " ".join(verify_path(folder).to_json_dict()["problems"])
        path.write_bytes(whole)
    (folder / "session.json").write_bytes(b"{")
    pull_session(server, sealed.id, tmp_path)
    assert (folder / "session.json.damaged-1").read_bytes() == b"{"
    assert find_verdict(verify_path(folder)) == "complete"


def test_no_session_is_pulled_into_a_data_folder(
    server: Client, sealed: Sealed, tmp_path: Path
) -> None:
    folder = sealed.session.folder
    before = (folder / "session.json").read_bytes()
    for out in (folder.parent, folder.parent.parent, folder):
        with pytest.raises(UsageError, match="this is a data folder"):
            pull_session(server, sealed.id, out)
    copied = tmp_path / "copied"
    shutil.copytree(folder.parent, copied)  # without the lock of the data folder
    with pytest.raises(UsageError, match=r"not one that `foottile pull` wrote"):
        pull_session(server, sealed.id, copied)
    assert (folder / "session.json").read_bytes() == before
    assert (copied / sealed.id / "session.json").read_bytes() == before
    assert not (folder.parent.parent / sealed.id).exists()


@pytest.mark.parametrize("have", [1, 1000, None])
def test_a_partial_file_is_resumed(
    server: Client, sealed: Sealed, tmp_path: Path, have: int | None
) -> None:
    folder = tmp_path / sealed.id
    folder.mkdir()
    (folder / ".frames.parquet.part").write_bytes(sealed.content[:have])
    pulled = pull_session(server, sealed.id, tmp_path)
    assert Path(pulled["path"]).read_bytes() == sealed.content
    assert pulled["resumed_bytes"] == (have or len(sealed.content))
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (".frames.parquet.part", b"x" * 1000),
        (".frames.parquet.part", b"x" * 10_000_000),
        ("frames.parquet", b"something else"),
    ],
    ids=["a part", "a part longer than the file", "a whole file"],
)
def test_a_wrong_file_is_replaced(
    server: Client, sealed: Sealed, tmp_path: Path, name: str, content: bytes
) -> None:
    folder = tmp_path / sealed.id
    folder.mkdir()
    (folder / name).write_bytes(content)
    with suppress(foottile.DamagedError):  # perhaps once
        pull_session(server, sealed.id, tmp_path)
    pull_session(server, sealed.id, tmp_path)
    assert (folder / "frames.parquet").read_bytes() == sealed.content


def test_an_unknown_or_unsealed_session_is_refused(
    server: Client, sealed: Sealed, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(foottile.ConflictError, match=r"is recording.*Stop it"):
        pull_session(server, sealed.recording.id, out)
    with pytest.raises(foottile.NotFoundError, match="no session"):
        pull_session(server, UNKNOWN_ID, out)
    assert not out.exists()


def test_a_missing_server_is_named(running: Running, tmp_path: Path) -> None:
    running.stop()
    with (
        foottile.connect(running.url) as server,
        pytest.raises(foottile.ServerUnavailableError, match="foottile serve"),
    ):
        pull_session(server, UNKNOWN_ID, tmp_path)


@pytest.mark.parametrize("to", ["parquet", "arrow", "csv", "mcap", "mat", "xdf"])
def test_a_slice_is_the_download_under_a_name_of_its_own(
    server: Client, sealed: Sealed, tmp_path: Path, to: str
) -> None:
    names = ("t_ns", "grf_n")
    pulled = pull_export(server, sealed.id, tmp_path, Slice(0.25, 0.5, names), get_format(to))
    path = Path(pulled["path"])
    assert path.name == f"{sealed.id}_0.25s-0.5s.{to}"
    assert pulled["bytes"] == path.stat().st_size
    query: dict[str, Any] = {"start_s": 0.25, "end_s": 0.5, "columns": ",".join(names)}
    assert path.read_bytes() == sealed.export(format=to, **query).content
    assert list(tmp_path.rglob("*.tmp")) == []


def test_a_refused_or_damaged_slice_leaves_no_file(
    server: Client, sealed: Sealed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = r"MATLAB is available when it is sealed.*xdf"
    for id_, part, to, error, reason in (
        (
            sealed.id,
            Slice(columns=("weight_n",)),
            "arrow",
            foottile.InvalidRequestError,
            "no column",
        ),
        (sealed.recording.id, Slice(0, 1), "parquet", foottile.ConflictError, "is recording"),
        (sealed.recording.id, Slice(), "mat", foottile.ConflictError, waiting),
    ):
        with pytest.raises(error, match=reason):
            pull_export(server, id_, tmp_path, part, get_format(to))
    with pytest.raises(UsageError, match="this is a data folder"):
        pull_export(server, sealed.id, sealed.session.folder, Slice(0, 1), get_format("arrow"))
    read = httpx.Response.iter_bytes

    def read_half(answer: httpx.Response, size: int | None = None) -> Iterator[bytes]:
        content = b"".join(read(answer, size))
        yield content if size is None else content[: len(content) // 2]

    monkeypatch.setattr(httpx.Response, "iter_bytes", read_half)
    for to in ("parquet", "arrow"):
        with pytest.raises(foottile.DamagedError, match="the slice is incomplete"):
            pull_export(server, sealed.id, tmp_path, Slice(0.25, 0.5), get_format(to))
    assert list(tmp_path.iterdir()) == []
