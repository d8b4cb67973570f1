"""Both compose files, brought up for real where there is an engine: a node, a cluster's work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.service.offline.archives import IDS, sealed
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[1]
COMPOSE = ("docker", "compose") if shutil.which("docker-compose") is None else ("docker-compose",)
UP_S = 300.0
Compose = Callable[..., str]


def engine_answers() -> bool:
    if shutil.which("docker") is None:
        return False
    return subprocess.run(["docker", "info"], capture_output=True).returncode == 0


pytestmark = [
    pytest.mark.soak,
    pytest.mark.skipif(not engine_answers(), reason="no Docker engine answers"),
]


@pytest.fixture
def compose(tmp_path: Path) -> Iterator[Compose]:
    """Runs `docker compose ARGUMENTS` with a file and images of this checkout; down at the end."""
    used: list[Path] = []
    environment = {
        **os.environ,
        "FOOTTILE_TOKEN": "0123456789abcdef0123456789abcdef",
        "FOOTTILE_ARCHIVE": str(tmp_path / "archive"),
        "COMPOSE_PROJECT_NAME": f"foottile-test-{os.getpid()}",
    }

    def run(file: Path, *words: str) -> str:
        used.append(file)
        command = [*COMPOSE, "-f", str(file), *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    yield run
    for file in dict.fromkeys(used):
        run(file, "down", "--volumes", "--timeout", "20")


def built(tag: str, extras: str, lock: str = "requirements.lock") -> None:
    arguments = ("--build-arg", f"EXTRAS={extras}", "--build-arg", f"LOCK={lock}")
    words = ("build", "--network", "host", *arguments, "-t", tag, str(ROOT))
    subprocess.run(["docker", *words], check=True, capture_output=True)


def healthy(compose: Compose, file: Path, service: str) -> bool:
    container = compose(file, "ps", "-q", service).split()[0]
    words = ("inspect", "--format", "{{json .State.Health}}", container)
    told = subprocess.run(["docker", *words], check=True, capture_output=True, text=True).stdout
    return bool(json.loads(told)["Status"] == "healthy")


def test_server_and_node_come_up_and_find_each_other(compose: Compose) -> None:
    file = ROOT / "docker-compose.yml"
    built("foottile", "server,emulation")
    compose(file, "up", "--detach", "--no-build")
    until(lambda: healthy(compose, file, "server"), UP_S)
    until(lambda: healthy(compose, file, "node"), UP_S)


def test_a_cluster_comes_up_lets_nobody_in_from_outside_and_does_the_work(
    compose: Compose, tmp_path: Path
) -> None:
    file = ROOT / "deploy" / "docker-compose.yml"
    built("foottile-archive", "server,archive", "requirements-dev.lock")
    for number in range(4):
        sealed(tmp_path / "archive", number, 20.0, 30.0)
    for path in (tmp_path / "archive", *(tmp_path / "archive").rglob("*")):
        path.chmod(0o777 if path.is_dir() else 0o666)
    compose(file, "up", "--detach", "--no-build", "--scale", "worker=2", "scheduler", "worker")
    until(lambda: healthy(compose, file, "scheduler"), UP_S)
    (scheduler,) = compose(file, "ps", "-q", "scheduler").split()
    ports = subprocess.run(["docker", "port", scheduler], check=True, capture_output=True).stdout
    assert ports == b""
    words = ("foottile", "estimate", "/archive/sessions", "--out", "/archive/estimated")
    said = compose(
        file, "run", "--rm", "-T", "client", *words, "--scheduler", "tcp://scheduler:8786"
    )
    assert "4 made" in said
    made = tmp_path / "archive" / "estimated"
    assert {path.name for path in made.iterdir() if path.is_dir()} == set(IDS[:4])
    again = compose(
        file, "run", "--rm", "-T", "client", *words, "--scheduler", "tcp://scheduler:8786"
    )
    assert "0 made, 4 there before" in again
