"""`serve`, `demo`, `sessions` and `pull` as a user types them, with settings and tokens.

What serves is a process of its own; what asks it, or is refused, runs in that of the test.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

import foottile
from tests.service.cli.outcome import Run
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S, until

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
    if tared:
        until(lambda: any(node["tare"] for node in demo.get("/nodes").json()["items"]), every_s=0.1)
    return demo


def ended(process: subprocess.Popen[str]) -> int:
    code = process.wait(PATIENCE_S)
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
    until(lambda: demo.get(f"/sessions/{started['id']}").json()["frames"] >= 300, every_s=0.1)
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
def test_a_second_server_on_the_same_port_or_folder_is_refused(
    run: Run, demo: Demo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = demo.url.rsplit(":", 1)[1]
    done = run("serve", "--port", port, "--data", str(tmp_path / "other"))
    done.fails(1, f"port {port}", "--port")
    monkeypatch.delenv("FOOTTILE_TOKEN")
    done = run("serve", "--port", "0", "--data", str(demo.data))
    done.fails(1, "another foottile server uses this data folder")
    assert not (demo.data / "token").exists(), "it would be the first server's to make one"


@pytest.mark.slow(parts=8)
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


@pytest.mark.slow
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


@pytest.mark.slow
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
