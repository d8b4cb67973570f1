"""What is installed: whole, built from wherever it is built, and quick to start."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from shutil import copy2
from typing import Any, get_args

import pytest

from devices import errors
from service.api.app import find_page_folder
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = {path.parent.name for path in ROOT.glob("*/__init__.py")}
"""Every package of the checkout. Tests and benchmarks are none."""


def build(kind: str, source: Path, out: Path) -> Path:
    """Build a wheel or an sdist of a source folder."""
    words = (sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out))
    subprocess.run(words, cwd=source, check=True, capture_output=True, timeout=PATIENCE_S)
    (built,) = out.glob("foottile-*")
    return built


def unpack_sdist(folder: Path) -> Path:
    """Make the source distribution of the checkout and unpack it."""
    archive = build("sdist", ROOT, folder / "built")
    with tarfile.open(archive) as file:
        if hasattr(tarfile, "data_filter"):
            file.extractall(folder, filter="data")
        else:  # Python 3.11.2 of Debian
            file.extractall(folder)  # noqa: S202  # built here
    return folder / archive.name.removesuffix(".tar.gz")


def is_ignored(path: str, rules: list[str]) -> bool:
    """Does Docker leave a path out of the build context? The last rule that matches decides."""
    parts = path.split("/")
    above = ["/".join(parts[: n + 1]) for n in range(len(parts))]
    ignored = False
    for rule in rules:
        pattern = rule.removeprefix("!").strip("/")
        anywhere = pattern.removeprefix("**/")
        if pattern == anywhere:
            depth = pattern.count("/")
            hit = depth < len(above) and fnmatchcase(above[depth], pattern)
        else:
            hit = any(fnmatchcase(part, anywhere) for part in parts)
        if hit:
            ignored = not rule.startswith("!")
    return ignored


def copy_build_context(folder: Path) -> Path:
    """Copy into `folder` what the Dockerfile's build stage copies, less what Docker ignores."""
    rules = [
        line.strip()
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    stage = (ROOT / "Dockerfile").read_text().split("\nFROM ")[1]
    copies = [line.split()[1:] for line in stage.splitlines() if line.startswith("COPY ")]
    assert copies
    for source in sorted(context_files(rules)):
        name = source.relative_to(ROOT).as_posix()
        for *given, into in copies:
            for root in given:
                if root == "." or name == root:
                    copy_file(source, folder / into / name)
                elif name.startswith(f"{root}/"):
                    copy_file(source, folder / into / name.removeprefix(f"{root}/"))
    return folder


def context_files(rules: list[str]) -> Iterator[Path]:
    """Yield every file of the checkout that Docker's build gets to see."""
    for top in ROOT.iterdir():
        if top.name in (".git", ".venv", ".venv-lowest"):
            assert is_ignored(top.name, rules)
            continue
        for path in (top, *top.rglob("*")):
            if path.is_file() and not is_ignored(path.relative_to(ROOT).as_posix(), rules):
                yield path


def copy_file(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    copy2(source, target)


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Wheels of the checkout, of its source distribution, and of the image's build context."""
    folder = tmp_path_factory.mktemp("wheels")
    sources = {
        "checkout": ROOT,
        "sdist": unpack_sdist(folder / "unpacked"),
        "image": copy_build_context(folder / "context"),
    }
    return {name: build("wheel", source, folder / name) for name, source in sources.items()}


def unpack(wheel: Path, folder: Path) -> None:
    zipfile.ZipFile(wheel).extractall(folder)  # noqa: S202  # built here


def names_in(wheel: Path) -> set[str]:
    return {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}


@pytest.mark.slow
def test_a_wheel_holds_every_file_of_the_packages_and_the_page_and_no_more(
    wheels: dict[str, Path],
) -> None:
    expected = {
        path.relative_to(folder.parent).as_posix().replace("web/", "service/web/", 1)
        if folder.name == "web"
        else path.relative_to(ROOT).as_posix()
        for folder in (ROOT / name for name in (*PACKAGES, "web"))
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"devices/scene/builtin/standing.toml", "service/web/index.html"} <= expected
    assert {source: names_in(wheel) ^ expected for source, wheel in wheels.items()} == {
        "checkout": set(),
        "sdist": set(),
        "image": set(),
    }


@pytest.mark.slow
@pytest.mark.parametrize("source", ["checkout", "sdist", "image"])
def test_a_wheel_alone_runs_its_command(
    source: str, wheels: dict[str, Path], tmp_path: Path
) -> None:
    """Without `site`, so that the checkout, which the tests have installed, is not found."""
    unpack(wheels[source], tmp_path)
    (entry,) = PROJECT["project"]["scripts"].values()
    module, function = entry.split(":")
    code = f"""
import sys
sys.path[:0] = [{str(tmp_path)!r}, {sysconfig.get_path("purelib")!r}]
sys.argv = ["foottile", "--version"]
from {module} import {function}
{function}()
"""
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.stdout == f"foottile {PROJECT['project']['version']}\n", done.stderr


def test_every_list_of_packages_names_all_of_them() -> None:
    tool = PROJECT["tool"]
    assert set(tool["hatch"]["build"]["targets"]["wheel"]["packages"]) == PACKAGES
    assert set(tool["importlinter"]["root_packages"]) == PACKAGES
    assert set(tool["mypy"]["files"]) >= PACKAGES
    assert set(errors.OUR_PACKAGES) == PACKAGES


EXTRAS = set(PROJECT["project"]["optional-dependencies"])
SAYS_EXTRAS = (
    *ROOT.glob("*.md"),
    *ROOT.glob("docs/*.md"),
    *(path for name in PACKAGES for path in (ROOT / name).rglob("*.py")),
)


def test_every_extra_that_a_file_asks_for_is_one_of_the_package() -> None:
    asked: dict[str, set[str]] = {}
    for path in SAYS_EXTRAS:
        for found in re.findall(r"foottile\[([a-z,]+)\]", path.read_text()):
            asked.setdefault(path.name, set()).update(found.split(","))
    assert asked["raspberry-pi.md"] >= {"server", "emulation"}
    builds = {
        name: (ROOT / name).read_text() for name in ("Dockerfile", "deploy/docker-compose.yml")
    }
    for name, text in builds.items():
        found = re.findall(r"EXTRAS[=:] *([a-z,]+)$", text, re.MULTILINE)
        assert found, name
        asked[name] = {extra for each in found for extra in each.split(",")}
    asked["devices.errors"] = set(get_args(errors.Extra))
    assert {name: extras - EXTRAS for name, extras in asked.items() if extras - EXTRAS} == {}


def container_commands(folder: Path) -> list[list[str]]:
    """Every command of ours that an image, a compose file or the node's script runs."""
    text = "\n".join(
        (ROOT / name).read_text()
        for name in ("Dockerfile", "docker-compose.yml", "deploy/docker-compose.yml")
    )
    lists = re.findall(r"^ *(?:CMD|command:) \[\"?foottile\"?, (.*)\]$", text, re.MULTILINE)
    printer = folder / "foottile"
    printer.write_text("#!/bin/sh\nprintf '%s\\n' \"$@\"\n")
    printer.chmod(0o755)
    node = subprocess.run(
        ["sh", str(ROOT / "scripts" / "container-node")],
        # `python` of the image has the package.
        env={
            "PATH": f"{folder}{os.pathsep}{sysconfig.get_path('scripts')}{os.pathsep}/usr/bin:/bin"
        },
        check=True,
        capture_output=True,
        text=True,
    )
    return [
        *([w.strip().strip('"') for w in each.split(",")] for each in lists),
        node.stdout.split(),
    ]


@pytest.mark.slow
def test_containers_run_commands_that_there_are(tmp_path: Path) -> None:
    commands = container_commands(tmp_path)
    assert [words[0] for words in commands] == ["serve", "serve", "--help", "node"]
    for words in commands:
        done = subprocess.run(
            [sys.executable, "-c", "from service.cli.main import main; main()", *words, "--help"],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_an_installed_wheel_and_a_checkout_both_find_the_page(
    wheels: dict[str, Path], tmp_path: Path
) -> None:
    assert find_page_folder() == ROOT / "web"
    unpack(wheels["checkout"], tmp_path)
    code = "import service.api.app; print(service.api.app.find_page_folder())"
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, timeout=60
    )
    assert Path(found.stdout.decode().strip()) == tmp_path / "service" / "web"


HEAVY = ("fastapi", "starlette", "uvicorn", "httpx", "numba", "scipy", "matplotlib")


@pytest.mark.parametrize(
    ("imports", "absent"),
    [
        ("service.cli.main", ("numpy", "pydantic", "pyarrow", *HEAVY)),
        ("service.cli.commands.node, service.node.running_node", HEAVY),
        ("service.node.local_recording, service.sessions.sealing, service.protocol", HEAVY),
    ],
    ids=["help", "a node", "a node that seals without a calibration"],
)
def test_what_needs_no_heavy_library_loads_none(imports: str, absent: tuple[str, ...]) -> None:
    code = f"import sys, {imports}; print([m for m in {absent!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, timeout=PATIENCE_S
    )
    assert done.stdout.decode().strip() == "[]"
