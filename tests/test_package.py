"""What is installed: whole, and quick to start."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]


def test_a_wheel_holds_the_scenes_and_the_packages_and_no_tests(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=PATIENCE_S)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    scenes = sorted((ROOT / "devices" / "scene" / "builtin").glob("*.toml"))
    assert scenes
    for scene in scenes:
        assert f"devices/scene/builtin/{scene.name}" in names
    for path in (ROOT / "web").rglob("*.*"):
        assert f"service/web/{path.relative_to(ROOT / 'web')}" in names
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {
        *("devices", "storage", "service", "foottile")
    }


def test_an_installed_wheel_and_a_checkout_both_find_the_page(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=PATIENCE_S)
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    code = "import service.api.app; print(service.api.app.page_folder())"
    for root, page in (
        (tmp_path / "installed", tmp_path / "installed" / "service" / "web"),
        (ROOT, ROOT / "web"),
    ):
        found = subprocess.run(
            [sys.executable, "-c", code], cwd=root, check=True, capture_output=True, timeout=60
        )
        assert Path(found.stdout.decode().strip()) == page


HEAVY = ("fastapi", "starlette", "uvicorn", "httpx", "numba", "scipy", "matplotlib")


@pytest.mark.parametrize(
    ("imports", "absent"),
    [
        ("service.cli.main", ("numpy", "pydantic", "pyarrow", *HEAVY)),
        ("service.cli.commands.node, service.node.run", HEAVY),
        ("service.node.recording, service.sessions.sealing, service.link", HEAVY),
    ],
    ids=["help", "a node", "a node that seals without a calibration"],
)
def test_what_needs_no_heavy_library_loads_none(imports: str, absent: tuple[str, ...]) -> None:
    code = f"import sys, {imports}; print([m for m in {absent!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, timeout=PATIENCE_S
    )
    assert done.stdout.decode().strip() == "[]"
