"""`serve`, `node`, `demo`, `sessions`, `pull`, `export` as a user types them.

What serves is a process of its own; what asks it, or is refused, runs in that of the test.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

import foottile
from tests.service.cli.outcome import Run
from tests.tokens import SHARED_BEARER

pytestmark = pytest.mark.process

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]


@dataclass
class Demo:
    link: str
    data: Path
    process: subprocess.Popen[str]

    @property
    def url(self) -> str:
        return self.link.partition("/#")[0]

    def get(self, path: str) -> httpx.Response:
        return httpx.get(f"{self.url}/api/v1{path}", headers=SHARED_BEARER, trust_env=False)

    def post(self, path: str, body: object = None) -> httpx.Response:
        return httpx.post(
            f"{self.url}/api/v1{path}", json=body, headers=SHARED_BEARER, trust_env=False
        )


def tiny_scene(folder: Path) -> Path:
    """Two tiles that bear a standing load, with a preset: no bench has to be pressed."""
    text = (
        'name = "tiny"\ncalibration = "paper-eq2-shape"\n[ground]\nkind = "plate"\nload_n = 10.0\n'
    )
    for i in range(2):
        text += f'[[tile]]\nserial = "T0{i + 1}"\nmux = 0x70\nchannel = {i}\n'
        text += f"x_m = {0.02 * i}\ny_m = 0\nz_m = -0.15\n"
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


def start_demo(folder: Path, *options: str, tared: bool = True) -> Demo:
    arguments = ["demo", f"--scene={tiny_scene(folder)}", "--port=0", f"--data={folder / 'data'}"]
    with (folder / "stderr.txt").open("w") as stderr:
        process = subprocess.Popen(
            [*COMMAND, *arguments, *options], stdout=subprocess.PIPE, stderr=stderr, text=True
        )
    assert process.stdout is not None
    link = process.stdout.readline().split()[-1]
    demo = Demo(link, folder / "data", process)
    end = time.monotonic() + 30
    while tared and not any(node["tare"] for node in demo.get("/nodes").json()["items"]):
        assert time.monotonic() < end, (folder / "stderr.txt").read_text()
        time.sleep(0.1)
    return demo


def ended(process: subprocess.Popen[str]) -> int:
    code = process.wait(30)
    assert process.stdout is not None
    process.stdout.close()
    return code


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Demo]:
    demo = start_demo(tmp_path_factory.mktemp("demo"))
    yield demo
    demo.process.send_signal(signal.SIGINT)
    assert ended(demo.process) == 0


@pytest.fixture(scope="module")
def session(demo: Demo) -> str:
    """Id of a sealed session of about two seconds."""
    started = demo.post("/sessions", {"node": "demo", "name": "=1+1 [b]"}).json()
    end = time.monotonic() + 30
    while demo.get(f"/sessions/{started['id']}").json()["frames"] < 300:
        assert time.monotonic() < end
        time.sleep(0.1)
    stopped = demo.post(f"/sessions/{started['id']}/stop").json()
    assert stopped["state"] == "sealed"
    return str(stopped["id"])


@pytest.mark.real_time
def test_sessions_are_listed_from_a_server_and_from_a_folder(
    run: Run, demo: Demo, session: str
) -> None:
    asked = run("sessions", "--server", demo.url, "--json").printed()["items"]
    found = run("sessions", "--data", str(demo.data), "--json").printed()["items"]
    assert [s["id"] for s in asked] == [s["id"] for s in found] == [session]
    assert asked[0]["complete"] is found[0]["complete"] is True
    for where in (("--server", demo.url), ("--data", str(demo.data))):
        wanted = ("--node", "demo", "--complete", "true", "--from", "2020-01-01", "--search", "1+1")
        chosen = run("sessions", *where, *wanted, "--json").printed()["items"]
        assert [s["id"] for s in chosen] == [session]
        for other in (("--to", "2020-01-01"), ("--tag", "mud"), ("--take", "x")):
            assert run("sessions", *where, *other, "--json").printed()["items"] == []
    table = run("sessions", "--server", demo.url)
    assert session in table.out
    assert "=1+1 [b]" in table.out


@pytest.mark.real_time
def test_pull_brings_the_file_verified_and_at_once_the_second_time(
    run: Run, demo: Demo, session: str, tmp_path: Path
) -> None:
    first = run("pull", session, "--server", demo.url, "--out", str(tmp_path), "--json")
    assert first.code == 0, first.err
    pulled = first.printed()
    table = pq.read_table(pulled["path"])
    assert (np.diff(table["seq"].to_numpy()) == 1).all()
    assert len(table) == pulled["frames"]
    folder = tmp_path / session
    assert {path.name for path in folder.iterdir()} == {
        *("frames.parquet", "session.json", "markers.json", "ledger.json", "clock.parquet"),
        "markers.parquet",
    }
    before = (folder / "frames.parquet").stat().st_mtime_ns
    assert run("pull", session, "--server", demo.url, "--out", str(tmp_path)).code == 0
    assert (folder / "frames.parquet").stat().st_mtime_ns == before


@pytest.mark.real_time
def test_pull_of_a_missing_session_is_refused(run: Run, demo: Demo, tmp_path: Path) -> None:
    done = run("pull", "../../etc", "--server", demo.url, "--out", str(tmp_path))
    done.fails(2, "foottile sessions")
    done = run("pull", "20200101T000000Z-000000", "--server", demo.url, "--out", str(tmp_path))
    done.fails(1, "no session")


@pytest.mark.real_time
def test_exports_have_the_same_rows_in_every_format(
    run: Run, demo: Demo, session: str, tmp_path: Path
) -> None:
    tables = {}
    for name in ("parquet", "arrow", "csv"):
        out = tmp_path / f"session.{name}"
        done = run(
            *("export", session, "--data", str(demo.data), "--format", name, "--out", str(out)),
            *("--columns", "seq,t_ns,force_n,contact", "--start-s", "0.2", "--end-s", "0.9"),
        )
        assert done.code == 0, done.err
        tables[name] = {
            "parquet": pq.read_table,
            "arrow": lambda out: pa.ipc.open_file(out.read_bytes()).read_all(),
            "csv": pacsv.read_csv,
        }[name](out)
    names = ["seq", "t_ns", "force_n_0", "force_n_1", "contact"]
    for table in tables.values():
        assert table.column_names == names
        assert table["seq"].to_pylist() == tables["parquet"]["seq"].to_pylist()
        assert np.allclose(table["force_n_0"], tables["parquet"]["force_n_0"], rtol=1e-6)
    whole = tmp_path / "whole.parquet"
    done = run(
        "export", session, "--data", str(demo.data), "--format", "parquet", "--out", str(whole)
    )
    assert done.code == 0, done.err
    t_ns = pq.read_table(whole)["t_ns"].to_numpy()
    since_s = (t_ns - t_ns[0]) * 1e-9
    within = t_ns[(since_s >= 0.2) & (since_s < 0.9)]
    assert len(within) > 20
    assert tables["csv"]["t_ns"].to_pylist() == within.tolist()
    assert (tables["arrow"].schema.field("force_n_0").metadata or {})[b"unit"] == b"N"


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--format", "xlsx"), "one of parquet, arrow, csv"),
        (("--format", "csv", "--columns", "nonsense"), "no column 'nonsense'"),
    ],
)
def test_a_refused_export_leaves_no_file(
    run: Run, demo: Demo, session: str, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "out.csv"
    done = run("export", session, "--data", str(demo.data), "--out", str(out), *options)
    done.fails(2, message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
def test_a_second_server_on_the_same_port_or_folder_is_refused(
    run: Run, demo: Demo, tmp_path: Path
) -> None:
    port = demo.url.rsplit(":", 1)[1]
    done = run("serve", "--port", port, "--data", str(tmp_path / "other"))
    done.fails(1, f"port {port}", "--port")
    done = run("serve", "--port", "0", "--data", str(demo.data))
    done.fails(1, "another foottile server uses this data folder")


@pytest.mark.real_time
def test_a_second_node_of_the_same_name_is_refused_with_the_reason(
    demo: Demo, tmp_path: Path
) -> None:
    node = subprocess.Popen(
        [
            *COMMAND,
            "node",
            f"--scene={tiny_scene(tmp_path)}",
            f"--server={demo.url}",
            "--name=demo",
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert node.stderr is not None
    message = ""
    with node.stderr:
        while "not connected" not in message:
            line = node.stderr.readline()
            assert line, message
            message += line
        node.terminate()
        node.wait(20)
    assert "foottile accept-node demo" in message
    assert demo.get("/nodes/demo").json()["connected"]


def test_a_demo_prints_one_link_that_logs_a_browser_in_and_commands_need_no_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FOOTTILE_TOKEN")
    demo = start_demo(tmp_path, "--host=0.0.0.0", tared=False)
    login = f"http://127.0.0.1:{demo.url.rsplit(':', 1)[1]}/api/v1/login"
    ticket = {"ticket": demo.link.partition("/#ticket=")[2]}
    answers = [httpx.post(login, json=ticket, trust_env=False) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [200, 401]
    assert answers[0].json()["role"] == "operator"
    with foottile.connect(login.removesuffix("/api/v1/login")) as server:
        assert server.create_invite()["role"] == "operator"
    demo.process.send_signal(signal.SIGINT)
    assert ended(demo.process) == 0
    message = (tmp_path / "stderr.txt").read_text()
    assert (demo.data / "token").read_text().strip() not in message + demo.link


@pytest.mark.real_time
def test_ctrl_c_seals_the_session_that_is_being_recorded(run: Run, tmp_path: Path) -> None:
    demo = start_demo(tmp_path)
    started = demo.post("/sessions", {"node": "demo", "name": "cut short"}).json()
    demo.process.send_signal(signal.SIGINT)
    assert ended(demo.process) == 0
    (found,) = run("sessions", "--data", str(demo.data), "--json").printed()["items"]
    assert (found["id"], found["state"], found["complete"]) == (started["id"], "sealed", True)
    with pytest.raises(httpx.ConnectError):
        demo.get("/health")


@pytest.mark.real_time
def test_a_demo_ends_by_itself_after_its_seconds(tmp_path: Path) -> None:
    demo = start_demo(tmp_path, "--seconds", "1", tared=False)
    assert ended(demo.process) == 0
    assert "ended after 1 s" in (tmp_path / "stderr.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("node", "--scene", "leg.toml"), 2, "no file 'leg.toml' and no built-in scene"),
        (("node", "--scene", "."), 2, "scene '.' cannot be read"),
        (("node", "--scene", "standing", "--server", "nonsense"), 2, "no server address"),
        (("node", "--scene", "standing", "--name", "../x"), 2, "--name"),
        (("node", "--scene", "standing", "--servo", "/dev/ttyUSB9"), 2, "has no servo"),
        (("node", "--scene", "insole"), 2, "--load"),
        (("demo", "--scene", "nonsense"), 2, "no file 'nonsense'"),
        (("sessions", "--server", "http://127.0.0.1:1"), 1, "no answer"),
        (("sessions", "--server", "ftp://x"), 2, "no server address"),
        (("sessions", "--data", "/nowhere"), 2, "no data folder"),
        (("pull", "--out", "here"), 2, "nothing to pull is named"),
        (("pull", "a", "--take", "b", "--out", "here"), 2, "--take exclude each other"),
        (("export", "nothere", "--format", "csv", "--out", "x"), 2, "`foottile pull ID"),
        (("verify", "nothere"), 2, "`foottile pull ID"),
        (("serve", "--config", "/nowhere.toml"), 2, "no settings file"),
        (("serve", "--host", "192.0.2.1", "--port", "0"), 1, "192.0.2.1"),
    ],
)
def test_wrong_options_are_refused_with_the_reason(
    run: Run,
    arguments: tuple[str, ...],
    code: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    done = run(*arguments)
    done.fails(code, message)
    assert "Traceback" not in done.err


def test_settings_come_from_option_environment_and_file_in_that_order(
    run: Run, tmp_path: Path
) -> None:
    config = tmp_path / "foottile.toml"
    config.write_text(f'port = 1\ndata = "{tmp_path / "from-file"}"\n')
    serve = subprocess.Popen(
        [*COMMAND, "serve", "--config", str(config), "--port", "0"],
        env={**os.environ, "FOOTTILE_PORT": "2", "FOOTTILE_DATA": str(tmp_path / "from-env")},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert serve.stdout is not None
    assert "http://127.0.0.1:" in serve.stdout.readline()
    serve.terminate()
    assert ended(serve) == 0
    assert (tmp_path / "from-env").is_dir()
    assert not (tmp_path / "from-file").exists()
    config.write_text("prot = 1\n")
    done = run("serve", "--config", str(config))
    done.fails(2, "prot")


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])  # noqa: S104  # of this test
def test_a_token_is_made_kept_and_asked_for_and_commands_of_its_user_find_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str
) -> None:
    monkeypatch.delenv("FOOTTILE_TOKEN")
    log = tmp_path.with_name("log")
    with log.open("w") as stderr:
        serve = subprocess.Popen(
            [
                *(*COMMAND, "serve", f"--host={host}", "--port", "0", "--data", str(tmp_path)),
                *("--advertise", "robot.example"),
            ],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
    assert serve.stdout is not None
    line = serve.stdout.readline()
    url = line.split()[-1].rstrip("/")
    assert url.startswith("http://robot.example:")
    url = f"http://127.0.0.1:{url.rsplit(':', 1)[1]}"
    assert (tmp_path / "token").stat().st_mode & 0o077 == 0
    token = (tmp_path / "token").read_text().strip()
    refused = httpx.post(f"{url}/api/v1/nodes/x/tare", trust_env=False)
    allowed = httpx.post(
        f"{url}/api/v1/nodes/x/tare", headers={"Authorization": f"Bearer {token}"}, trust_env=False
    )
    assert (refused.status_code, allowed.status_code) == (401, 404)
    by_name = httpx.get(f"{url}/api/v1/nodes", headers={"Host": "evil.example"}, trust_env=False)
    assert by_name.status_code == 403
    by_name = httpx.get(f"{url}/api/v1/nodes", headers={"Host": "robot.example"}, trust_env=False)
    assert by_name.status_code == 200
    found = run("invite", "--server", url)
    assert "/#ticket=" in found.out, found.err
    serve.terminate()
    assert ended(serve) == 0
    message = log.read_text()
    assert str(tmp_path / "token") in message
    assert token not in message + line  # they may be a log


def test_a_taken_port_is_named(run: Run, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run("demo", "--scene", str(tiny_scene(tmp_path)), "--port", str(port))
    done.fails(1, f"port {port}")
