"""A client that pulls sessions, and resumes."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

import foottile
from devices.errors import UsageError
from service.pull import pull_export, pull_session
from storage.formats.slice import Slice
from storage.formats.writers.registry import get_format
from storage.verify.data_folder import find_verdict, verify_path
from tests.service.api.sealed import Sealed
from tests.service.running import Running
from tests.storage.formats.exports import TABLES


def test_the_client_pulls_a_session_whole(sealed: Sealed, tmp_path: Path) -> None:
    with foottile.connect(sealed.running.url) as server:
        assert {each.id for each in server.sessions()} == {sealed.id, sealed.recording.id}
        pulled = pull_session(server, sealed.id, tmp_path / "out")
        assert Path(pulled["path"]).read_bytes() == sealed.content
        assert pulled["resumed_bytes"] == 0
        folder = tmp_path / "out" / sealed.id
        assert {path.name for path in folder.iterdir()} == {
            "frames.parquet",
            "session.json",
            "markers.json",
            "markers.parquet",
            "ledger.json",
            "clock.parquet",
        }
        again = pull_session(server, sealed.id, tmp_path / "out")
        assert again["path"] == pulled["path"]


def test_what_is_pulled_proves_itself_file_by_file(sealed: Sealed, tmp_path: Path) -> None:
    with foottile.connect(sealed.running.url) as server:
        pull_session(server, sealed.id, tmp_path)
        folder = tmp_path / sealed.id
        report = verify_path(folder)
        assert (find_verdict(report), report.to_json_dict()["unproven"]) == (
            "complete",
            [],
        )
        for path in sorted(folder.iterdir()):
            whole = path.read_bytes()
            path.write_bytes(whole[:40] + bytes([whole[40] ^ 1]) + whole[41:])
            assert path.name in " ".join(verify_path(folder).to_json_dict()["problems"])
            path.write_bytes(whole)
        (folder / "session.json").write_bytes(b"{")
        pull_session(server, sealed.id, tmp_path)
        assert (folder / "session.json.damaged-1").read_bytes() == b"{"
        assert find_verdict(verify_path(folder)) == "complete"


def test_nothing_is_pulled_into_a_servers_data_folder(sealed: Sealed, tmp_path: Path) -> None:
    folder = sealed.session.folder
    before = (folder / "session.json").read_bytes()
    with foottile.connect(sealed.running.url) as server:
        for out in (folder.parent, folder.parent.parent, folder):
            with pytest.raises(UsageError, match="this is a data folder"):
                pull_session(server, sealed.id, out)
        copied = tmp_path / "copied"
        shutil.copytree(folder.parent, copied)  # without the lock, but still not ours
        with pytest.raises(UsageError, match=r"not one that `foottile pull` wrote"):
            pull_session(server, sealed.id, copied)
    assert (folder / "session.json").read_bytes() == before
    assert (copied / sealed.id / "session.json").read_bytes() == before
    assert not (folder.parent.parent / sealed.id).exists()


@pytest.mark.parametrize("have", [1, 1000, None])
def test_the_client_resumes_a_partial_file(
    sealed: Sealed, tmp_path: Path, have: int | None
) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / ".frames.parquet.part").write_bytes(sealed.content[:have])
    with foottile.connect(sealed.running.url) as server:
        pulled = pull_session(server, sealed.id, tmp_path / "out")
    assert Path(pulled["path"]).read_bytes() == sealed.content
    assert pulled["resumed_bytes"] == (have or len(sealed.content))
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize(
    "partial", [b"x" * 1000, b"x" * 10_000_000], ids=["shorter", "longer than the file"]
)
def test_the_client_repairs_a_partial_file_that_is_wrong(
    sealed: Sealed, tmp_path: Path, partial: bytes
) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / ".frames.parquet.part").write_bytes(partial)
    with foottile.connect(sealed.running.url) as server:
        with suppress(foottile.DamagedError):  # it may say so, once
            pull_session(server, sealed.id, tmp_path / "out")
        pull_session(server, sealed.id, tmp_path / "out")
    assert (folder / "frames.parquet").read_bytes() == sealed.content


def test_the_client_replaces_a_file_that_is_wrong(sealed: Sealed, tmp_path: Path) -> None:
    folder = tmp_path / "out" / sealed.id
    folder.mkdir(parents=True)
    (folder / "frames.parquet").write_bytes(b"something else")
    with foottile.connect(sealed.running.url) as server:
        pull_session(server, sealed.id, tmp_path / "out")
    assert (folder / "frames.parquet").read_bytes() == sealed.content


def test_the_client_says_that_a_session_is_not_sealed(sealed: Sealed, tmp_path: Path) -> None:
    with (
        foottile.connect(sealed.running.url) as server,
        pytest.raises(foottile.ConflictError, match=r"is recording.*Stop it"),
    ):
        pull_session(server, sealed.recording.id, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_client_says_that_there_is_no_such_session(sealed: Sealed, tmp_path: Path) -> None:
    with (
        foottile.connect(sealed.running.url) as server,
        pytest.raises(foottile.NotFoundError, match="no session"),
    ):
        pull_session(server, "20200101T000000Z-000000", tmp_path)


def test_the_client_says_that_no_server_answers(running: Running, tmp_path: Path) -> None:
    running.stop()
    with (
        foottile.connect(running.url) as server,
        pytest.raises(foottile.ServerUnavailableError, match="foottile serve"),
    ):
        pull_session(server, "20200101T000000Z-000000", tmp_path)


@pytest.mark.parametrize("to", TABLES)
def test_the_client_pulls_a_slice(sealed: Sealed, tmp_path: Path, to: str) -> None:
    part = Slice(0.25, 0.5, ("t_ns", "grf_n"))
    with foottile.connect(sealed.running.url) as server:
        pulled = pull_export(server, sealed.id, tmp_path / "out", part, get_format(to))
    path = Path(pulled["path"])
    assert path.name == f"{sealed.id}_0.25s-0.5s.{to}"
    assert pulled["bytes"] == path.stat().st_size
    table = {
        "parquet": lambda: pq.read_table(path),
        "arrow": lambda: pa.ipc.open_file(path.read_bytes()).read_all(),
        "csv": lambda: pacsv.read_csv(path),
    }[to]()
    whole = pq.read_table(io.BytesIO(sealed.content), columns=["t_ns", "grf_n"])
    since_ns = whole["t_ns"].to_numpy() - whole["t_ns"][0].as_py()
    expected = whole.filter((since_ns >= 0.25e9) & (since_ns < 0.5e9))
    assert table["t_ns"].to_pylist() == expected["t_ns"].to_pylist()
    assert table.num_rows > 0
    assert list(tmp_path.rglob("*.tmp")) == []


def test_the_client_pulls_any_format_and_one_of_sealed_sessions_waits_for_that(
    sealed: Sealed, tmp_path: Path
) -> None:
    begins = {"mcap": b"\x89MCAP0", "mat": b"MATLAB 5.0", "xdf": b"XDF:"}
    with foottile.connect(sealed.running.url) as server:
        for name, begin in begins.items():
            pulled = pull_export(server, sealed.id, tmp_path, Slice(0.25, 0.5), get_format(name))
            assert Path(pulled["path"]).read_bytes().startswith(begin)
            assert Path(pulled["path"]).name == f"{sealed.id}_0.25s-0.5s.{name}"
        with pytest.raises(
            foottile.ConflictError, match=r"MATLAB is available when it is sealed.*xdf"
        ):
            pull_export(server, sealed.recording.id, tmp_path, Slice(), get_format("mat"))


def test_a_slice_that_is_refused_leaves_nothing_behind(sealed: Sealed, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with foottile.connect(sealed.running.url) as server:
        with pytest.raises(foottile.UsageError, match="no column"):
            pull_export(server, sealed.id, out, Slice(columns=("weight_n",)), get_format("arrow"))
        with pytest.raises(foottile.ConflictError, match="is recording"):
            pull_export(server, sealed.recording.id, out, Slice(0.0, 1.0), get_format("parquet"))
        with pytest.raises(UsageError, match="this is a data folder"):
            pull_export(
                server, sealed.id, sealed.session.folder, Slice(0.0, 1.0), get_format("arrow")
            )
    assert list(out.iterdir()) == []


def test_a_slice_that_is_damaged_on_its_way_is_refused(
    sealed: Sealed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    given = httpx.Response.iter_bytes

    def short(answer: httpx.Response, size: int | None = None) -> Iterator[bytes]:
        content = b"".join(given(answer, size))
        yield content if size is None else content[: len(content) // 2]

    monkeypatch.setattr(httpx.Response, "iter_bytes", short)
    for to in ("parquet", "arrow"):
        with (
            foottile.connect(sealed.running.url) as server,
            pytest.raises(foottile.DamagedError, match="the slice is incomplete"),
        ):
            pull_export(server, sealed.id, out, Slice(0.25, 0.5), get_format(to))
    assert list(out.iterdir()) == []
