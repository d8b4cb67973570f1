"""Where things are kept of a user who has a home, and of one who has none."""

from __future__ import annotations

import os
import pwd
from pathlib import Path
from typing import Any, get_args

import pytest

from devices.errors import UsageError
from devices.jit import jit_cached
from service.api.settings import load_settings
from service.user_folders import FolderKind, resolve_user_folder

KINDS = get_args(FolderKind)


@pytest.fixture
def no_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As `docker run --user 12345`, and a unit of systemd with `DynamicUser=`."""

    def no_account(_uid: int) -> Any:
        raise KeyError("uid not found")

    for name in ("HOME", "NUMBA_CACHE_DIR", *(f"XDG_{kind.upper()}_HOME" for kind in KINDS)):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", no_account)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("no_home")
def test_without_a_home_the_error_says_which_option_names_a_folder(
    kind: FolderKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=f"with --where, or in XDG_{kind.upper()}_HOME"):
        resolve_user_folder(kind, None, "--where")
    with pytest.raises(UsageError, match="Write the whole path"):
        resolve_user_folder(kind, Path("~/walks"), "--where")
    assert resolve_user_folder(kind, tmp_path / "walks", "--where") == tmp_path / "walks"
    monkeypatch.setenv(f"XDG_{kind.upper()}_HOME", str(tmp_path / "xdg"))
    assert resolve_user_folder(kind, None, "--where") == tmp_path / "xdg" / "foottile"


@pytest.mark.usefixtures("no_home")
def test_a_home_in_which_nothing_can_be_written_is_named_with_the_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "root"))
    monkeypatch.setattr(os, "access", lambda *_: False)  # as `/` is to user 12345
    with pytest.raises(UsageError, match=r"cannot write in .*root.* with --where"):
        resolve_user_folder("data", None, "--where")
    resolve_user_folder("state", None, "--where")  # a node goes on without a disk
    (tmp_path / "root" / ".local" / "share" / "foottile").mkdir(parents=True)
    assert resolve_user_folder("data", None, "--where").is_dir()  # one that is there may be read


@pytest.mark.usefixtures("no_home")
def test_a_server_without_a_home_asks_for_its_option_and_takes_one_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"^no home folder is known .* with --data"):
        load_settings(None)
    monkeypatch.setenv("FOOTTILE_DATA", str(tmp_path))
    assert load_settings(None).data == tmp_path


def test_a_tilde_that_no_shell_has_replaced_is_the_home_and_no_folder_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert resolve_user_folder("data", Path("~/walks"), "--data") == tmp_path / "walks"
    monkeypatch.setenv("FOOTTILE_DATA", "~/walks")
    assert load_settings(None).data == tmp_path / "walks"


@pytest.mark.usefixtures("no_home")
def test_machine_code_is_kept_where_there_is_a_folder_for_it_and_nowhere_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def double(x: float) -> float:
        return 2.0 * x

    in_tree = Path(__file__).parent / "__pycache__"
    monkeypatch.setattr("numba.core.caching.os.makedirs", _refuses(in_tree, os.makedirs))
    assert jit_cached(double)(2.0) == 4.0
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert jit_cached(double)(2.0) == 4.0
    assert list((tmp_path / "cache" / "numba").rglob("*.nbi"))


def _refuses(folder: Path, make: Any) -> Any:
    """`os.makedirs` to which one folder is read-only, as an installation is to a user."""

    def refusing(path: str, *args: Any, **options: Any) -> None:
        if Path(path) == folder:
            raise PermissionError(path)
        make(path, *args, **options)

    return refusing
