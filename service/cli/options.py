"""Shared parts of commands: option types, output paths, progress, printing, stop signals.

Also the options of an emulated foot.
"""

from __future__ import annotations

import asyncio
import inspect
import math
import os
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from devices.errors import UsageError, escape_control_chars
from devices.scene.hardware_sections import EMULATED
from devices.scene.scene_file import Scene, load_scene
from foottile.environment import read_variable
from service.cli.reference_options import TableOptions, make_reference_options
from service.json_output import to_json_text

if TYPE_CHECKING:
    from service.rig.emulated_foot import EmulatedFoot, PlateFiles

SEED_MAX = 2**63 - 1
SECONDS_MAX = NUMBER_MAX = 1e9
"""Upper bounds of options: thirty years, and more than any plausible length, force or factor."""

DataOption = Annotated[
    Path | None, typer.Option(help="Data folder of the server; default: the user's.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
UnquantizedOption = Annotated[
    bool,
    typer.Option("--no-quantize", help="Keep estimates as computed: do not round off their noise."),
]
ChipOption = Annotated[
    str | None, typer.Option(help="Kind of pressure chip in all tiles; default: the scene's.")
]
BusOption = Annotated[
    str | None,
    typer.Option(help="I2C bus: /dev/i2c-1, usb:1c40:0534 or emulated; default: the scene's."),
]
ServoOption = Annotated[
    str | None,
    typer.Option(help="Serial port of the servo, emulated, or none; default: the scene's."),
]
EstimatorOption = Annotated[
    str,
    typer.Option(
        help="Estimator: models; or, to compare, low-pass: static curve and low-pass of 5 ms."
    ),
]
CaOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Further trusted CA certificates in PEM, for an https server.",
    ),
]
SESSION_REMEDY = (
    "`foottile sessions` lists a server's sessions, `foottile pull ID --out here` downloads one; "
    "or name the data folder with --data"
)
"""Remedy if a session is not on this computer."""
StartOption = Annotated[
    float | None, typer.Option(help="First instant, seconds after the first frame.")
]
EndOption = Annotated[float | None, typer.Option(help="End, exclusive, in the same seconds.")]


EXIT_INCOMPLETE = 3
"""Exit code: finished, but something failed, is missing, or is not as it was required."""


class _SafeConsole(Console):
    """Console that escapes control characters in texts and table cells."""

    def render_str(self, text: str, **how: Any) -> Text:
        return super().render_str(escape_control_chars(text, keep_line_breaks=True), **how)


class _StdoutConsole(_SafeConsole):
    def on_broken_pipe(self) -> None:
        # The reader has ended, as with `| head -1`: no failure.
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


# Data goes to stdout; progress and remarks to stderr, progress only on a terminal.
# A pipe or a file needs no line breaks.
stdout = _StdoutConsole(width=None if sys.stdout.isatty() or read_variable("COLUMNS") else 500)
stderr = _SafeConsole(stderr=True)


def parse_pair(text: str | None, option: str) -> tuple[float, float] | None:
    """Return two comma-separated numbers.

    Raises:
        UsageError: not a pair, or a number out of range.
    """
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (abs(first) < NUMBER_MAX and abs(second) < NUMBER_MAX):
        raise UsageError(f"{option} {text!r} is no pair of sensible numbers", expected="A,B")
    return first, second


def resolve_data_folder(values: Path | None) -> Path:
    """Return the data folder that `--data` names, or the user's."""
    from service.user_folders import resolve_user_folder

    return resolve_user_folder("data", values, "--data")


def resolve_output_path(path: Path, *inputs: Path) -> Path:
    """Return the file to write, links resolved, and check early that it can be written.

    Raises:
        UsageError: the folder is missing or not writable, the path is not a regular file, or it
            is an input, which would be lost.
    """
    target = _resolve_links(path)
    folder = target.parent
    if not folder.is_dir():
        raise UsageError(f"no folder {str(folder)!r} to write {path.name} in", remedy="Make it")
    is_file = target.is_file() or not os.path.lexists(target)  # a circular link also exists
    if not (is_file and os.access(folder, os.W_OK)):
        raise UsageError(f"{str(path)!r} cannot be written")
    if any(target == _resolve_links(values) for values in inputs):
        raise UsageError(
            f"{str(path)!r} is an input and would be lost", remedy="Write to another file"
        )
    return target


def _resolve_links(path: Path) -> Path:
    return Path(os.path.realpath(path))  # Path.resolve fails on circular links


def print_json(value: object) -> None:
    """Print one JSON document on stdout."""
    sys.stdout.write(to_json_text(value))


@contextmanager
def show_progress(message: str) -> Iterator[Callable[[str], None]]:
    """Show a running task on a terminal.

    The yielded function shows its progress: in the same line on a terminal, else as a line each
    on stderr.
    """
    if not stderr.is_terminal:
        yield remark
        return
    # The default spinner uses Braille, which some encodings lack.
    spinner = "dots" if is_encodable("⠋") else "line"
    with stderr.status(escape(escape_control_chars(message)), spinner=spinner) as status:
        yield lambda text: status.update(escape(escape_control_chars(text)))


@contextmanager
def show_progress_bar(message: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar and the remaining time on a terminal.

    The yielded function shows how many are done.
    """
    if not stderr.is_terminal:
        yield lambda done: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    text = TextColumn("{task.description}", markup=False)
    bar = Progress(text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=stderr)
    with bar:
        task_id = bar.add_task(escape_control_chars(message), total=total)
        yield lambda done: bar.update(task_id, completed=done)


def is_encodable(text: str) -> bool:
    """Return whether the encodings of both streams have all characters of a text."""
    try:
        for stream in (sys.stdout, sys.stderr):
            text.encode(stream.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True


def echo(message: str) -> None:
    """Print one line of the result on stdout, with line breaks escaped."""
    indent = " " * (len(message) - len(message.lstrip(" ")))
    echo_lines(indent + escape_control_chars(message))


def echo_lines(text: str) -> None:
    """Print several lines on stdout; names must already be escaped."""
    stdout.print(text, highlight=False, soft_wrap=True, markup=False)


def remark(message: str) -> None:
    """Print one line on stderr, also without a terminal."""
    stderr.print(
        escape_control_chars(message), style="dim", highlight=False, markup=False, soft_wrap=True
    )


def format_not_sampled(share: float) -> str:
    """Return the share of slots that were not sampled, as the pages do; empty without any."""
    if not share:
        return ""
    return f", {'<1' if share < 0.01 else round(100 * share)} % not sampled"


def exit_incomplete_for(problems: Collection[str]) -> None:
    """Print each problem on stderr, and exit with code 3 if there is one."""
    for problem in problems:
        remark(problem)
    if problems:
        raise typer.Exit(EXIT_INCOMPLETE)


@dataclass(frozen=True)
class FootOptions:
    """Options of an emulated foot, of a command decorated by `add_options`."""

    load: Annotated[
        Path | None, typer.Option(help="Recorded load in place of the scene's ground.")
    ] = None
    table: TableOptions = field(default_factory=TableOptions)
    load_scale: Annotated[float, typer.Option(help="Factor on every force of the load.")] = 1.0
    cop_scale: Annotated[float, typer.Option(help="Factor on the load's COP about its mean.")] = 1.0
    cop_offset_m: Annotated[
        str, typer.Option(metavar="X,Y", help="Position of the load's mean COP, m.")
    ] = "0,0"
    cop_axes: Annotated[
        str, typer.Option(help="Axes of the load that become x and y: xy, yx, -yx, ...")
    ] = "xy"
    lead_s: Annotated[float, typer.Option(help="Unloaded seconds at the start, for the tare.")] = (
        1.0
    )
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX, help="Random seed of noise and ground.")
    ] = 0
    parts_seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Random seed of parts.")] = 0
    force_plate: Annotated[
        Path | None,
        typer.Option(help="CSV of an emulated force plate under the foot, written at the end."),
    ] = None
    pressure_plate: Annotated[
        Path | None,
        typer.Option(help="Frames (.npz) of an emulated pressure plate, written at the end."),
    ] = None

    def make_foot(self, scene: Scene) -> EmulatedFoot:
        """Return the emulated foot for a scene.

        Raises:
            UsageError: conflicting options, or an implausible number.
            LoadTraceError: the load is not readable.
        """
        from devices.emulation.ground.load_trace import CopTransform
        from service.rig.emulated_foot import EmulatedFoot
        from storage.formats.load_trace import read_load_to_emulate
        from storage.formats.reference import ReferenceOptions

        for option, value, least in (
            ("--load-scale", self.load_scale, 0.0),
            ("--cop-scale", self.cop_scale, None),
            ("--lead-s", self.lead_s, -1e-9),
        ):
            if not abs(value) < NUMBER_MAX or (least is not None and value <= least):
                raise UsageError(f"{option} {value:g}", expected="a sensible positive number")
        if self.load is not None and scene.array.bus != EMULATED:
            raise UsageError("--load presses emulated tiles only", remedy="Add --bus emulated")
        plates = self._make_plate_files(scene)
        stated = make_reference_options(vars(self.table), self.table.rate_hz)
        if self.load is None and stated != ReferenceOptions():
            raise UsageError(
                "the options of a table go with --load",
                remedy="Add --load FILE",
            )
        if scene.array.bus == EMULATED and scene.ground.kind == "trace" and self.load is None:
            raise UsageError(
                f"scene {scene.name!r} needs a recorded load, and none is named",
                remedy="Add --load FILE",
            )
        offset_m = parse_pair(self.cop_offset_m, "--cop-offset-m") or (0.0, 0.0)
        return EmulatedFoot(
            load=read_load_to_emulate(self.load, stated) if self.load is not None else None,
            load_scale=self.load_scale,
            cop_transform=CopTransform(self.cop_scale, offset_m, self.cop_axes),
            lead_s=self.lead_s,
            seed=self.seed,
            parts_seed=self.parts_seed,
            plates=plates,
        )

    def _make_plate_files(self, scene: Scene) -> PlateFiles:
        from devices.emulation.plates import check_plate_usable
        from service.rig.emulated_foot import PlateFiles

        for name, path, ending in (
            ("force plate", self.force_plate, ".csv"),
            ("pressure plate", self.pressure_plate, ".npz"),
        ):
            if path is None:
                continue
            option = f"--{name.replace(' ', '-')}"
            if scene.array.bus != EMULATED:
                raise UsageError(f"{option} is emulated, and the tiles are not")
            if path.suffix != ending:
                raise UsageError(
                    f"{option} {str(path)!r}", expected=f"a file that ends in {ending}"
                )
            resolve_output_path(path)
            check_plate_usable(name, scene)
        return PlateFiles(self.force_plate, self.pressure_plate)

    def to_arguments(self) -> list[str]:
        """Return these options as arguments of another command."""
        return [
            f"--{name.replace('_', '-')}={value}"
            for name, value in {**vars(self), **vars(self.table)}.items()
            if value is not None and name != "table"
        ]


def add_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Replace parameters whose type is a dataclass by options for its fields, nested ones too."""
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        if is_dataclass(parameter.annotation):
            make_options = add_options(cast(Callable[..., Any], parameter.annotation))
            parameters = inspect.signature(make_options, eval_str=True).parameters.values()
            command = expand_options(command, name, parameters, make_options)
    return command


def expand_options(
    command: Callable[..., Any],
    name: str,
    parameters: Collection[inspect.Parameter],
    make_options: Callable[..., Any],
) -> Callable[..., Any]:
    """Replace the parameter `name` of a command by these, from which its value is made."""
    own = inspect.signature(command, eval_str=True)
    expanded: list[inspect.Parameter] = []
    for parameter in own.parameters.values():
        expanded += parameters if parameter.name == name else [parameter]
    names = [parameter.name for parameter in parameters]

    @wraps(command, updated=())
    def run(**values: Any) -> Any:
        options = make_options(**{each: values.pop(each) for each in names})
        return command(**values, **{name: options})

    by_name = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in expanded]
    run.__signature__ = own.replace(parameters=by_name)  # type: ignore[attr-defined]  # for typer
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in expanded}
    return run


def require_finite_numbers(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command to reject NaN and infinity in its options."""

    @wraps(command)
    def run(**values: Any) -> None:
        for name, value in values.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise UsageError(
                    f"--{name.replace('_', '-')} {value:g}", expected="a finite number"
                )
        command(**values)

    return run


def check_emulated(scene: Scene) -> None:
    """Reject a scene of real hardware, for commands that only emulate.

    Raises:
        UsageError: its bus or its servo is real.
    """
    if scene.array.bus != EMULATED:
        raise UsageError(
            f"scene {scene.name!r} is for {scene.array.bus}, and this command only emulates",
            remedy='Set array.bus = "emulated"',
        )
    if scene.servo is not None and scene.servo.port != EMULATED:
        raise UsageError(
            f"the servo of scene {scene.name!r} is at {scene.servo.port}, and this command only "
            "emulates",
            remedy='Set servo.port = "emulated"',
        )


def load_adapted_scene(
    name: str, *, bus: str | None, servo: str | None, chip: str | None = None
) -> Scene:
    """Load a scene and replace its bus, the port of its servo, or its pressure chips.

    A scene of real hardware that is emulated has no sync lines: their pins may be wired.

    Raises:
        SceneError: no such scene.
        UsageError: the scene has no servo.
    """
    scene = load_scene(name, chip)
    if bus == EMULATED != scene.array.bus and scene.sync is not None:
        remark("the lines of [sync] are not used: their pins are real, and the bus is emulated")
        scene = scene.model_copy(update={"sync": None})
    if bus is not None:
        scene = scene.model_copy(update={"array": scene.array.model_copy(update={"bus": bus})})
    if servo == "none":
        return scene.model_copy(update={"servo": None})
    if servo is not None:
        if scene.servo is None:
            raise UsageError(
                f"scene {scene.name!r} has no servo, and --servo {servo} names its port",
                remedy="Add a [servo] section to the scene",
            )
        scene = scene.model_copy(update={"servo": scene.servo.model_copy(update={"port": servo})})
    return scene


def create_stop_event() -> asyncio.Event:
    """Return an event of the running loop that Ctrl-C and SIGTERM set."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    return stop


@contextmanager
def open_result_folder(out: Path) -> Iterator[Path]:
    """Yield a folder, created if missing and removed again after an error if empty.

    Raises:
        UsageError: the folder cannot be created or written.
    """
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make_folder(out)
        yield out.resolve()
    except BaseException:
        for folder in missing:
            with suppress(OSError):  # not empty, or not created yet
                folder.rmdir()
        raise


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"folder {str(out)!r} cannot be created: {error}") from error
    if not os.access(out, os.W_OK):
        raise UsageError(f"folder {str(out)!r} is not writable")
