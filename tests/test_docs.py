"""The documents say what the code does: every key, column and command is in them."""

from __future__ import annotations

import ast
import asyncio
import configparser
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from devices.scene.emulation_sections import (
    EmulationSection,
    FaultSection,
    GroundSection,
    MudGround,
    PoppyGround,
)
from devices.scene.hardware_sections import (
    ArraySection,
    RecoverySection,
    ReferenceSection,
    ServoSection,
    SyncSection,
    TileSection,
)
from devices.scene.scene_file import Scene, list_builtin_scenes, load_scene
from service.api.access import Logins
from service.api.app import make_app
from service.api.settings import Settings
from service.cli.main import GROUPS, SUMMARIES, load_command
from service.estimation.calibration import TileCalibration
from service.protocol.codec import LinkCloseCode
from service.protocol.live import FeedMessage, PageMessage
from service.server.server import Server
from storage.schema import COLUMNS_BY_NAME
from tests.tokens import SHARED_TOKEN

ROOT = Path(__file__).resolve().parents[1]
SCENES = (ROOT / "docs" / "scenes.md").read_text("utf-8")
API = (ROOT / "docs" / "api.md").read_text("utf-8")
FORMATS = (ROOT / "docs" / "formats.md").read_text("utf-8")
README = (ROOT / "README.md").read_text("utf-8")
COMMANDS = README + (ROOT / "docs" / "commands.md").read_text("utf-8")

GROUNDS = get_args(get_args(GroundSection)[0])
SECTIONS = {
    *("array", "tile", "servo", "reference", "recovery", "sync", "ground", "emulation", "fault")
}


@pytest.mark.parametrize(
    "section",
    [
        *(Scene, ArraySection, TileSection, ServoSection, ReferenceSection, RecoverySection),
        SyncSection,
        *(EmulationSection, FaultSection, *GROUNDS),
    ],
)
def test_every_scene_key_is_documented(section: type[BaseModel]) -> None:
    for key in section.model_fields:
        if key not in SECTIONS or section is not Scene:
            assert f"`{key}`" in SCENES, key


def test_every_ground_and_builtin_scene_is_documented() -> None:
    for ground in GROUNDS:
        assert f"`{get_args(ground.model_fields['kind'].annotation)[0]}`" in SCENES
    for scene in list_builtin_scenes():
        assert f"`{scene}`" in SCENES


@pytest.mark.parametrize(
    ("heading", "section"),
    [
        ("[array]", ArraySection),
        ("[servo]", ServoSection),
        ("[reference]", ReferenceSection),
        ("[recovery]", RecoverySection),
        ("[sync]", SyncSection),
        ("[emulation]", EmulationSection),
    ],
)
def test_documented_defaults_are_the_defaults(heading: str, section: type[BaseModel]) -> None:
    part = SCENES.split(f"### `{heading}`")[1].split("###")[0]
    cells = [[cell.strip() for cell in row.split("|")] for row in part.splitlines() if "`" in row]
    documented = {row[1].strip("`"): row[2].strip('`"') for row in cells if len(row) > 3}
    compared = 0
    for key, field in section.model_fields.items():
        if key in documented and isinstance(field.default, float | int | str):
            compared += 1
            shown = documented[key]
            if isinstance(field.default, str):
                assert shown == field.default, key
            elif isinstance(field.default, bool):
                assert shown == str(field.default).lower(), key
            else:
                assert float(shown) == field.default, key
    assert compared >= 3


def test_documented_defaults_of_hops_are_the_defaults() -> None:
    part = SCENES.split("### Hops")[1].split("\n##")[0]
    cells = [[cell.strip() for cell in row.split("|")] for row in part.splitlines() if "| `" in row]
    documented = {row[1].strip("`"): row[2] for row in cells}
    for ground in (PoppyGround, MudGround):
        for key, field in ground.model_fields.items():
            if key != "kind":
                assert f"{field.default:g}" in documented[key].split(), key


def test_every_column_is_documented_with_its_unit() -> None:
    for name, column in COLUMNS_BY_NAME.items():
        shown = f"`{name}_i`" if column.per_tile else f"`{name}`"
        row = next((line for line in FORMATS.splitlines() if line.startswith(f"| {shown} |")), None)
        assert row is not None, name
        assert f"| {column.unit} |" in row
        assert column.description in row


def commands() -> dict[str, Any]:
    found = {name: load_command(name) for name in SUMMARIES}
    for group in GROUPS:
        for name, command in found.pop(group).commands.items():
            found[f"{group} {name}"] = command
    return found


def test_every_command_is_documented_and_says_what_its_options_do() -> None:
    for name, command in commands().items():
        assert f"`foottile {name}`" in COMMANDS
        for parameter in command.params:
            if parameter.name != "help":
                assert parameter.help, f"{name} {parameter.name}"


def test_every_option_of_documented_commands_exists() -> None:
    known = {
        option for c in commands().values() for p in c.params for option in getattr(p, "opts", [])
    }
    for line in COMMANDS.splitlines():
        if line.startswith("foottile "):
            used = {word for word in line.split("#")[0].split() if word.startswith("--")}
            assert used <= known, line


def test_every_scene_and_file_of_documented_commands_exists() -> None:
    made = {"walk.csv", "jump.csv", "cal.json"}  # of the user, as the text says
    read = 0
    for block in re.findall(r"```sh\n(.*?)```", COMMANDS, re.DOTALL):
        for line in block.splitlines():
            words = line.split("#")[0].split()
            if words[:1] == ["cp"]:
                assert (ROOT / words[1]).is_file(), line
                load_scene(str(ROOT / words[1]))
                made.add(words[2])
            if words[:1] != ["foottile"]:
                continue
            given = [after for word, after in pairwise(words) if word in ("--scene", "--load")]
            given += [word for word in words[2:] if re.fullmatch(r"\w+\.(parquet|toml|json)", word)]
            outputs = {after for word, after in pairwise(words) if word in ("--out", "--plot")}
            for name in set(given) - outputs:
                read += 1
                assert name in made or name in list_builtin_scenes(), (
                    f"{name} of {line!r} is nowhere"
                )
            made |= outputs
    assert read > 8


def test_the_calibration_file_is_described() -> None:
    for name in ("r2", "rmse_n", "cv_rmse_n", "hysteresis_n"):
        assert name in TileCalibration.model_fields
        assert f"`{name}" in FORMATS


@cache
def openapi() -> dict[str, Any]:
    with TemporaryDirectory() as folder:
        server = Server(Path(folder))
        described = make_app(server, logins=Logins(SHARED_TOKEN)).openapi()
        asyncio.run(server.close())
    plain: dict[str, Any] = json.loads(json.dumps(described))
    return plain


def load_script(name: str) -> Any:
    spec = spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def test_the_api_description_and_the_types_of_the_pages_are_those_of_the_server() -> None:
    for kept, made in (
        (ROOT / "docs" / "openapi.json", json.dumps(openapi(), indent=1, sort_keys=True) + "\n"),
        (ROOT / "scripts" / "page_types.d.ts", load_script("page_types").render_types(openapi())),
    ):
        if os.environ.get("FOOTTILE_WRITE_OPENAPI"):
            kept.write_text(made)
        assert kept.read_text("utf-8") == made, (
            "if that is on purpose: FOOTTILE_WRITE_OPENAPI=1 sh scripts/test tests/test_docs.py"
        )


@pytest.mark.parametrize(
    ("schema", "said"),
    [({"type": "object"}, "unknown shape"), ({"type": "string"}, "Heartbeat has two shapes")],
)
def test_no_type_of_the_pages_is_a_guess(schema: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        load_script("page_types").render_types({"components": {"schemas": {"Heartbeat": schema}}})


def test_every_route_is_documented() -> None:
    for path, operations in openapi()["paths"].items():
        for method in operations:
            if method != "head":
                shown = path.removeprefix("/api/v1") or path
                assert f"`{method.upper()} {shown}`" in API, (method, path)


@pytest.mark.parametrize("messages", [PageMessage, FeedMessage])
def test_every_live_message_and_its_fields_are_documented(messages: Any) -> None:
    for message in get_args(get_args(messages)[0]):
        for kind in get_args(message.model_fields["type"].annotation):
            assert f"`{kind}`" in API, kind
        for name in message.model_fields:
            assert f"`{name}`" in API, name


def test_every_close_code_is_documented() -> None:
    for code in LinkCloseCode:
        assert str(code.value) in API, code


def test_every_setting_can_be_given_on_the_command_line() -> None:
    options = {parameter.name for parameter in commands()["serve"].params}
    assert set(Settings.model_fields) - {"token"} <= options


CITED = re.compile(
    r"\b(hardware|performance)\.md((?:,? (?:and |to )?\d{1,2}(?:\.\d)?\b(?!\.?\d))*)"
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def sources() -> Iterator[Path]:
    for folder in ("devices", "storage", "service", "studies", "tests", "benchmarks"):
        yield from sorted((ROOT / folder).rglob("*.py"))


def sections(document: Path) -> set[str]:
    return set(re.findall(r"^##+ (\d+(?:\.\d)?)\.? ", document.read_text("utf-8"), re.MULTILINE))


UNITS = sorted((ROOT / "deploy").glob("*.service"))
"""The units of systemd."""


def read_unit(path: Path) -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(strict=True, interpolation=None)
    parsed.optionxform = str  # type: ignore[assignment, method-assign]  # keys have capitals
    parsed.read(path, "utf-8")
    return parsed


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)
def test_a_unit_never_gives_up_and_starts_a_command_that_exists(path: Path) -> None:
    unit = read_unit(path)
    assert unit["Service"]["Type"] == "notify"
    assert unit["Service"]["Restart"] == "always"
    # systemd's own limit is five starts in ten seconds.
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert float(unit["Service"]["RestartSec"]) >= 1.0
    program, command, *arguments = shlex.split(unit["Service"]["ExecStart"])
    assert Path(program).name == "foottile"
    options = {option for parameter in commands()[command].params for option in parameter.opts}
    assert {argument for argument in arguments if argument.startswith("--")} <= options


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)
def test_systemd_finds_nothing_wrong_with_a_unit(path: Path, tmp_path: Path) -> None:
    unit = read_unit(path)
    unit["Service"]["ExecStart"] = "/bin/true"
    unit["Service"]["User"] = "root"
    copy = tmp_path / path.name
    with copy.open("w") as file:
        unit.write(file, space_around_delimiters=False)
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--recursive-errors=no", copy], capture_output=True, text=True
    )
    assert not [line for line in checked.stderr.splitlines() if path.name in line], checked.stderr


def test_every_section_that_the_source_cites_exists() -> None:
    known = {name: sections(ROOT / "docs" / f"{name}.md") for name in ("hardware", "performance")}
    cited = 0
    for path in sources():
        text = re.sub(r"\s+", " ", path.read_text("utf-8"))
        for document, numbers in CITED.findall(text):
            for number in re.findall(r"[\d.]+", numbers):
                cited += 1
                assert number in known[document], (
                    f"{path.relative_to(ROOT)}: {document}.md {number}"
                )
    assert cited > 80


def anchors(document: Path) -> set[str]:
    """Of its headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_between_documents_leads_somewhere(document: Path) -> None:
    for link in LINK.findall(document.read_text("utf-8")):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def packages() -> list[str]:
    return [
        str(folder.relative_to(ROOT))
        for top in ("devices", "storage", "service", "foottile", "studies")
        for folder in sorted({path.parent for path in (ROOT / top).rglob("*.py")})
    ]


def sign(package: str) -> str:
    """What stands over the door of a package: the first paragraph of its docstring."""
    init = ROOT / package / "__init__.py"
    text = ast.get_docstring(ast.parse(init.read_text("utf-8"))) if init.exists() else None
    return " ".join((text or "").split("\n\n")[0].split())


@pytest.mark.parametrize("package", packages())
def test_every_package_has_a_sign(package: str) -> None:
    assert sign(package).endswith(".")


def test_the_map_says_what_the_signs_say() -> None:
    page = ROOT / "CONTRIBUTING.md"
    text = page.read_text("utf-8")
    rows = ["| package | what lives there |", "|---|---|"]
    rows += [f"| `{package}/` | {sign(package)} |" for package in packages()]
    head, old = text.split("writes it -->\n", 1)
    tail = old[old.index("<!-- end of map -->") :]
    drawn = head + "writes it -->\n" + "\n".join(rows) + "\n" + tail
    if os.environ.get("FOOTTILE_WRITE_MAP"):
        page.write_text(drawn, "utf-8")
    assert page.read_text("utf-8") == drawn, (
        "if packages or their signs have changed: "
        "FOOTTILE_WRITE_MAP=1 sh scripts/test tests/test_docs.py"
    )


def test_no_module_but_registry_emulation_and_paper_is_made_for_one_pressure_chip() -> None:
    found = {
        str(path.relative_to(ROOT))
        for path in sources()
        if re.search(r"^from devices\..*\bmpl115a2\b", path.read_text("utf-8"), re.MULTILINE)
    }
    assert {name for name in found if not name.startswith(("tests/", "benchmarks/"))} == {
        "devices/chips/pressure_chips.py",
        "devices/emulation/chips/mpl115a2.py",
        "devices/emulation/world.py",
        "service/estimation/domes.py",  # the paper's table
    }


PATH = re.compile(
    r"`((?:devices|storage|service|web|tests|benchmarks|docs|scripts|\.ci)/[\w./-]*)`?"
)


SENTENCE_END = re.compile(r"[.:;!?]\)?\s+|\n\s*\n|\||\n\s*(?:[-*]|\d+\.) ")
of_today = pytest.mark.parametrize(
    "document",
    [d for d in DOCUMENTS if d.name != "CHANGELOG.md" and d.parent.name != "results"],
    ids=lambda path: str(path.relative_to(ROOT)),
)


@of_today
def test_every_path_in_a_document_exists(document: Path) -> None:
    for path in PATH.findall(document.read_text("utf-8")):
        assert (ROOT / path).exists(), path


@of_today
def test_no_sentence_names_a_path_twice(document: Path) -> None:
    # As it happens when two modules become one and their names are replaced.
    for sentence in SENTENCE_END.split(document.read_text("utf-8")):
        paths = PATH.findall(sentence)
        assert len(paths) == len(set(paths)), " ".join(sentence.split())


def test_every_decision_is_in_the_list_and_says_what_would_change_our_mind() -> None:
    folder = ROOT / "docs" / "decisions"
    listed = LINK.findall((folder / "README.md").read_text("utf-8"))
    records = sorted(folder.glob("0*.md"))
    assert listed == [record.name for record in records]
    for record in records:
        text = record.read_text("utf-8")
        for word in ("Context", "Decision", "Consequences", "What would change our mind"):
            assert f"\n**{word}.** " in text, record.name


def test_the_page_of_symptoms_is_that_of_its_document() -> None:
    help_page = load_script("help_page")
    text = help_page.SOURCE.read_text("utf-8")
    assert help_page.PAGE.read_text("utf-8") == help_page.render_page(text)


def test_every_path_in_the_picture_exists() -> None:
    drawing = (ROOT / "docs" / "images" / "architecture.svg").read_text("utf-8")
    paths = re.findall(r'class="mono"[^>]*>((?:devices|storage|service|web)[\w./]*)<', drawing)
    assert len(paths) > 10
    for path in paths:
        assert (ROOT / path).exists(), path
