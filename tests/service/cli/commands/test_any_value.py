"""Every command and option is in the table, and says no to absurd values in a sentence.

Commands and options are found, not listed: one that is added without a place here fails a test.
"""

from __future__ import annotations

import inspect
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import pytest

from devices.errors import StorageError
from service.cli import commands
from service.cli.main import COMMANDS, GROUPS, SUMMARIES, get_command_function
from service.cli.options import FootOptions, add_options
from service.cli.reference_options import TableOptions
from storage.permissions import set_umask_and_create_private_folder
from tests.service.cli.outcome import Outcome, Run

NUMBERS = ("nan", "inf", "-inf", "-1", "1e308", str(10**30))
NOT_FINITE = {"nan", "inf", "-inf"}

SHORT = (
    "simulate",
    "--scene",
    "standing",
    "--seconds",
    0.2,
    "--no-estimates",
    "--out",
    "x.parquet",
)
ARGUMENTS: dict[str, tuple[object, ...]] = {
    "accept-node": ("bench", "--server", "http://127.0.0.1:1"),
    "benchmark": ("--out", "bench", "--scene", "gone.toml"),
    "bridge": ("foxglove", "--server", "http://127.0.0.1:1"),
    "calibrate": ("s.parquet", "--out", "cal.json"),
    "compare": ("s.parquet", "--reference", "s.parquet", "--out", "o"),
    "demo": ("--scene", "gone.toml"),
    "doctor": ("--bus", "emulated"),
    "domes": (),
    "estimate": (
        *("s.parquet", "--out", "x.parquet"),
        *("--calibration", "paper-eq2-shape", "--models", "static"),
    ),
    "export": ("s.parquet", "--format", "csv", "--out", "x.csv"),
    "find": ("--json",),
    "node": ("--scene", "gone.toml"),
    "pull": ("20200101T000000Z-000000", "--out", "x", "--server", "http://127.0.0.1:1"),
    "query": ("SELECT 1", "--data", "."),
    "recover": (".",),
    "reproduce": ("--out", "s.parquet"),  # no folder: it ends at once
    "serve": ("--host", "192.0.2.1"),  # no address of this machine: it ends at once
    "sessions": ("--data", "."),
    "simulate": SHORT[1:],
    "stream": ("bench", "--server", "http://127.0.0.1:1"),
    "invite": ("--server", "http://127.0.0.1:1", "--data", "."),
    "verify": ("s.parquet",),
    "video add": ("s.parquet", "film.mp4"),
    "video align": ("s.parquet", "0" * 12, "--by", "hand"),
    "video list": ("s.parquet",),
    "video remove": ("s.parquet", "0" * 12),
    "video track": ("s.parquet", "0" * 12, "--dots", "red"),
}
"""For each command, arguments with which it ends within a moment."""


def kinds(annotation: Any) -> Iterator[Any]:
    """The types an option may have, without what typer is told beside them."""
    if get_origin(annotation) in (Union, UnionType, list):
        for part in get_args(annotation):
            yield from kinds(part)
    elif hasattr(annotation, "__metadata__"):
        yield from kinds(annotation.__origin__)
    else:
        yield annotation


def options(*wanted: type) -> list[tuple[str, str]]:
    """Command and option, of these types."""
    of_foot = set(inspect.signature(add_options(FootOptions)).parameters)
    found = []
    for command in COMMANDS:
        parameters = inspect.signature(get_command_function(command), eval_str=True).parameters
        for name, parameter in parameters.items():
            # An emulated foot is refused by one function, whoever asks for it.
            if command != "simulate" and name in of_foot:
                continue
            if set(kinds(parameter.annotation)) & set(wanted):
                found.append((command, name))
    return found


def test_every_command_has_its_place_here() -> None:
    assert set(ARGUMENTS) == set(COMMANDS)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a short session, made when it is first asked for."""
    return {}


@pytest.fixture
def run_short(run: Run, tmp_path: Path, sealed: dict[str, bytes]) -> Run:
    """Runs a command in a folder with a short session, `s.parquet`."""
    if not sealed:
        assert run(*SHORT).code == 0
        sealed["s"] = (tmp_path / "x.parquet").read_bytes()
        (tmp_path / "x.parquet").unlink()
    (tmp_path / "s.parquet").write_bytes(sealed["s"])
    return run


def check(outcome: Outcome, *codes: int) -> None:
    assert outcome.code in codes, outcome.err
    assert "Traceback" not in outcome.err
    if outcome.code in (1, 2):
        last = outcome.err.strip().splitlines()[-1]
        assert last.startswith(("foottile: ", "Error: ")), outcome.err
        assert len(last) < 1000
        assert last.isprintable()


@pytest.mark.parametrize(("command", "name"), options(int, float))
def test_an_absurd_number_is_refused_in_a_sentence(run_short: Run, command: str, name: str) -> None:
    option = f"--{name.replace('_', '-')}"
    for value in NUMBERS:
        outcome = run_short(*command.split(), *ARGUMENTS[command], f"{option}={value}")
        check(outcome, *((2,) if value in NOT_FINITE else (0, 1, 2, 3)))


@pytest.mark.parametrize("pair", ["nan,nan", "inf,0", "0,-inf", "1e308,1e308", "-1e308,1e308", "1"])
def test_an_absurd_pair_of_numbers_is_refused_in_a_sentence(run_short: Run, pair: str) -> None:
    check(run_short("estimate", *ARGUMENTS["estimate"], f"--tare-s={pair}"), 1, 2)
    (Path.cwd() / "load.csv").write_text("time_s,fz_n,cop_x_m,cop_y_m\n0,9,0,0\n1,9,0,0\n")
    check(run_short(*SHORT, "--load", "load.csv", f"--cop-offset-m={pair}"), 0, 1, 2)


# --- files and folders ----------------------------------------------------------------------------


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def truncated(path: Path, size: int) -> None:
    with path.open("wb") as file:
        file.truncate(size)


PLACES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "zeros": lambda path: path.symlink_to("/dev/zero"),
    "nothing": lambda path: path.symlink_to("/dev/null"),
    "pipe": os.mkfifo,
    "socket": listening,
    "loop": lambda path: path.symlink_to(path),
    "nowhere": lambda path: path.symlink_to("nothing here"),
    "empty": lambda path: path.write_bytes(b""),
    "junk": lambda path: path.write_bytes(bytes(range(256)) * 40),
    "hole": lambda path: truncated(path, 1 << 40),
    "no Parquet": lambda path: path.write_bytes(b"PAR1" + b"\xff" * 40 + b"PAR1"),
}
FOLDERS = {"folder", "missing"}
"""What may stand where a folder is asked for."""
FILES = {"missing", "nowhere", "empty", "junk", "hole", "no Parquet"}
"""What may be written over."""


VIDEO = [name for name in COMMANDS if name.startswith("video ")]
POINTS = ("s.parquet", "--begin-s", 0, "--points", "a,b", "--points-file")
READ: dict[tuple[str, str], tuple[object, ...]] = {
    ("benchmark", "scene"): ("--out", "bench", "--scene", "{}"),
    ("calibrate", "recordings"): ("{}", "--out", "cal.json"),
    ("calibrate", "reference"): ("s.parquet", "--out", "cal.json", "--reference", "{}"),
    ("compare", "session"): ("{}", "--reference", "s.parquet", "--out", "o"),
    ("compare", "manifest"): ("--manifest", "{}", "--out", "o"),
    ("compare", "reference"): ("s.parquet", "--reference", "{}", "--out", "o"),
    ("demo", "scene"): ("--scene", "{}"),
    ("doctor", "scene"): ("--scene", "{}"),
    ("estimate", "sessions"): ("{}", "--out", "x.parquet"),
    ("estimate", "manifest"): ("--manifest", "{}", "--out", "o"),
    ("estimate", "calibration"): ("s.parquet", "--out", "x.parquet", "--calibration", "{}"),
    ("estimate", "scene"): (*ARGUMENTS["estimate"], "--scene", "{}"),
    ("estimate", "angle"): (*ARGUMENTS["estimate"], "--angle", "{}"),
    ("export", "sessions"): ("{}", "--format", "csv", "--out", "x.csv"),
    ("export", "manifest"): ("--manifest", "{}", "--format", "csv", "--out", "o"),
    ("node", "scene"): ("--scene", "{}"),
    ("serve", "config"): ("--host", "192.0.2.1", "--config", "{}"),
    ("serve", "tls_cert"): ("--port", 0, "--tls-cert", "{}", "--tls-key", "{}"),
    ("serve", "tls_key"): ("--port", 0, "--tls-cert", "{}", "--tls-key", "{}"),
    ("simulate", "scene"): ("--scene", "{}", "--seconds", 1),
    ("simulate", "load"): ("--scene", "standing", "--load", "{}"),
    ("verify", "targets"): ("{}",),
    **{(name, "session"): ("{}", *ARGUMENTS[name][1:]) for name in VIDEO},
    ("video add", "film"): ("s.parquet", "{}"),
    ("video align", "lens"): (*ARGUMENTS["video align"], "--lens", "{}"),
    ("video track", "lens"): (*ARGUMENTS["video track"], "--lens", "{}"),
    ("video track", "points_file"): (*POINTS, "{}", "--out", "t.csv"),
    ("verify", "manifest"): ("--manifest", "{}"),
    ("calibrate", "ca"): (
        *("--live", "--tile", "T01", "--out", "cal.json"),
        *("--server", "https://127.0.0.1:1", "--ca", "{}"),
    ),
    ("node", "ca"): ("--scene", "standing", "--server", "https://127.0.0.1:1", "--ca", "{}"),
    ("sessions", "ca"): ("--server", "https://127.0.0.1:1", "--ca", "{}"),
    **{  # the last --server counts
        (command, "ca"): (*ARGUMENTS[command], "--server", "https://127.0.0.1:1", "--ca", "{}")
        for command in ("accept-node", "bridge", "pull", "stream", "invite")
    },
}
WRITTEN: dict[tuple[str, str], tuple[object, ...]] = {
    ("calibrate", "out"): ("s.parquet", "--out", "{}"),
    ("calibrate", "plot"): ("s.parquet", "--out", "cal.json", "--plot", "{}"),
    ("estimate", "out"): (
        *("s.parquet", "--out", "{}"),
        *("--calibration", "paper-eq2-shape", "--models", "static"),
    ),
    ("export", "out"): ("s.parquet", "--format", "csv", "--out", "{}"),
    ("query", "out"): ("SELECT 1", "--data", ".", "--out", "{}"),
    ("video track", "out"): (*POINTS, "k.csv", "--out", "{}"),
    ("simulate", "force_plate"): (*SHORT[1:], "--force-plate", "{}"),
    ("simulate", "out"): (*SHORT[1:-1], "{}"),
    ("simulate", "pressure_plate"): (*SHORT[1:], "--pressure-plate", "{}"),
}
IN_FOLDERS: dict[tuple[str, str], tuple[object, ...]] = {
    ("benchmark", "out"): ("--out", "{}", "--scene", "standing", "--seconds", 0.01),
    ("compare", "out"): ("s.parquet", "--reference", "s.parquet", "--out", "{}"),
    ("compare", "data"): (
        *("20200101T000000Z-000000", "--reference", "s.parquet"),
        *("--out", "o", "--data", "{}"),
    ),
    ("demo", "data"): ("--port", 0, "--data", "{}"),
    ("export", "data"): ("20200101T000000Z-000000", "--format=csv", "--out=x.csv", "--data", "{}"),
    ("node", "journal"): ("--scene", "standing", "--record", "a", "--journal", "{}"),
    ("pull", "out"): ("20200101T000000Z-000000", "--server=http://127.0.0.1:1", "--out", "{}"),
    ("query", "data"): ("SELECT 1", "--data", "{}"),
    ("recover", "folder"): ("{}",),
    ("reproduce", "out"): ("--out", "{}"),
    ("serve", "data"): ("--port", 0, "--data", "{}"),
    ("sessions", "data"): ("--data", "{}"),
    ("accept-node", "data"): ("bench", "--server", "http://127.0.0.1:1", "--data", "{}"),
    ("invite", "data"): ("--server", "http://127.0.0.1:1", "--data", "{}"),
    ("verify", "data"): ("20200101T000000Z-000000", "--data", "{}"),
    **{
        (name, "data"): ("20200101T000000Z-000000", *ARGUMENTS[name][1:], "--data", "{}")
        for name in VIDEO
    },
}


def test_every_path_has_its_place_here() -> None:
    known = {*READ, *WRITTEN, *IN_FOLDERS}
    assert set(options(Path)) <= known
    assert known <= set(options(Path, str))


def given(arguments: tuple[object, ...], name: str) -> list[object]:
    return [name if argument == "{}" else argument for argument in arguments]


@pytest.mark.parametrize(("command", "option"), READ)
def test_a_wrong_kind_of_file_is_refused_in_a_sentence(
    run_short: Run, tmp_path: Path, command: str, option: str
) -> None:
    # One function reads the certificates of all commands.
    is_read_elsewhere = option == "ca" and command != "sessions"
    for name in ("missing", "junk") if is_read_elsewhere else PLACES:
        PLACES[name](tmp_path / name)
        check(run_short(*command.split(), *given(READ[command, option], name)), 1, 2)
    assert not (tmp_path / "x.parquet").exists()


@pytest.mark.parametrize(("command", "option"), WRITTEN)
def test_an_output_in_the_place_of_a_special_file_is_refused_at_once(
    run_short: Run, tmp_path: Path, command: str, option: str
) -> None:
    for name in PLACES.keys() - FILES:
        PLACES[name](tmp_path / name)
        check(run_short(*command.split(), *given(WRITTEN[command, option], name)), 2)


@pytest.mark.parametrize(("command", "option"), IN_FOLDERS)
def test_a_file_in_the_place_of_a_folder_is_refused_in_a_sentence(
    run_short: Run, tmp_path: Path, command: str, option: str
) -> None:
    for name in PLACES.keys() - FOLDERS:
        PLACES[name](tmp_path / name)
        check(run_short(*command.split(), *given(IN_FOLDERS[command, option], name)), 1, 2)


def test_an_option_is_passed_on_by_its_name_on_the_command_line() -> None:
    assert "--map=grf_n=force" in FootOptions(table=TableOptions(map="grf_n=force")).to_arguments()


# --- paths that are not UTF-8 ---------------------------------------------------------------------


ODD = "odd\udcff"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_an_argument_and_a_working_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    arguments = ARGUMENTS[command]
    refused = run(*command.split(), *arguments, ODD)
    refused.fails(2, "not UTF-8", "odd\\udcff")
    assert refused.err.count("\n") == 1
    (tmp_path / ODD).mkdir()
    monkeypatch.chdir(tmp_path / ODD)
    run(*command.split(), *arguments).fails(2, "the working folder is not UTF-8")
    assert list((tmp_path / ODD).iterdir()) == []


def test_a_folder_of_a_variable_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", f"/nowhere/{ODD}")
    run("sessions", "--data", ".").fails(2, "XDG_DATA_HOME is not UTF-8")


def test_no_server_or_node_begins_to_write_in_such_a_folder(tmp_path: Path) -> None:
    umask = os.umask(0o022)
    os.umask(umask)
    with pytest.raises(StorageError, match="not UTF-8"):
        set_umask_and_create_private_folder(tmp_path / ODD)
    assert list(tmp_path.iterdir()) == []
    assert os.umask(umask) == umask


def test_a_session_in_such_a_folder_is_named_among_many(run: Run, tmp_path: Path) -> None:
    for name in ("one", ODD):
        (tmp_path / "all" / name).mkdir(parents=True)
        (tmp_path / "all" / name / "session.json").write_text("{}")
    outcome = run("verify", "all", "--jobs", 1, "--out", "out")
    outcome.fails(1, "all/odd\\udcff: the path is not UTF-8")
    assert outcome.err.count("not UTF-8") == 1


# --- the table of commands ------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in SUMMARIES if name not in GROUPS])
def test_a_summary_is_the_first_sentence_of_its_command(name: str) -> None:
    said = inspect.getdoc(get_command_function(name))
    assert said is not None
    assert said.replace("\n", " ").startswith(SUMMARIES[name])
    assert SUMMARIES[name].endswith(".")
    assert SUMMARIES[name][:-1].count(". ") == 0


def test_every_command_that_is_written_is_in_the_table() -> None:
    folder = Path(inspect.getfile(commands)).parent
    written = {
        line.removeprefix("def ").split("_command(")[0].replace("_", "-")
        for path in folder.glob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith("def ") and "_command(" in line
    }
    assert written == {name.replace(" ", "-") for name in COMMANDS}


def test_the_help_of_all_names_each_with_its_summary_and_that_of_one_is_its_own(run: Run) -> None:
    said = run("--help").out
    for name, summary in SUMMARIES.items():
        assert f"  {name} " in said
        assert summary[:30] in said
    assert "--family" in run("benchmark", "--help").out
