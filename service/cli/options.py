"""What several commands share: options that are pairs, output paths, progress, and JSON.

With them the options of an emulated foot, and how a command is told to stop.
"""

from __future__ import annotations

import asyncio
import inspect
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from devices.errors import UsageError
from devices.scene.hardware_sections import EMULATED
from devices.scene.scene_file import Scene, load_scene
from devices.text import escape_control_chars
from foottile.environment import read_variable
from service.cli.reference_options import (
    ColumnsOfReference,
    Decimal,
    Encoding,
    RateOfReference,
    SignOfReference,
    SkipRows,
    UnitsOfReference,
    UnitsRow,
    named_values,
    text_stated,
)
from service.json_output import to_json_text

if TYPE_CHECKING:
    from service.rig.emulated_foot import EmulatedFoot
    from service.rig.plate_files import PlateFiles
    from storage.formats.reference import ReferenceOptions

SEED_MAX = 2**63 - 1
SECONDS_MAX = NUMBER_MAX = 1e9
"""Thirty years; and more than any metre, newton or factor can be."""

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
ExactOption = Annotated[
    bool,
    typer.Option("--no-quantize", help="Keep estimates as computed: do not round off their noise."),
]
CaOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="CA certificates in PEM that an https server's may be of, beside the machine's own.",
    ),
]
StartOption = Annotated[
    float | None, typer.Option(help="From so many seconds after the first frame.")
]
EndOption = Annotated[float | None, typer.Option(help="Before so many seconds.")]


class _Screen(Console):
    """A console that shows control characters of any text or cell of a table, and obeys none."""

    def render_str(self, text: str, **how: Any) -> Text:
        return super().render_str(escape_control_chars(text, keep_line_breaks=True), **how)


class _Output(_Screen):
    def on_broken_pipe(self) -> None:
        # The reader has seen enough, as with `| head -1`: that is no failure.
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


def _width() -> int | None:
    # A pipe or a file has no edge at which a line or a cell would have to be broken.
    return None if sys.stdout.isatty() or read_variable("COLUMNS") else 500


# Data goes to stdout; progress and remarks to stderr, progress only on a terminal.
stdout = _Output(width=_width())
stderr = _Screen(stderr=True)


def pair(text: str | None, option: str) -> tuple[float, float] | None:
    """Two numbers with a comma between them.

    Raises:
        UsageError: anything else.
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


def data_folder(given: Path | None) -> Path:
    """Return the data folder that `--data` names, or the user's."""
    from service.user_folders import resolve_user_folder

    return resolve_user_folder("data", given, "--data")


def output_path(path: Path, *inputs: Path) -> Path:
    """Where to write, links resolved, after a look whether it can be, before anything takes time.

    Raises:
        UsageError: its folder is missing or not writable, it is no regular file, or one of the
            inputs, which would be lost.
    """
    target = _resolved(path)
    folder = target.parent
    if not folder.is_dir():
        raise UsageError(f"no folder {str(folder)!r} to write {path.name} in", remedy="Make it")
    is_file = target.is_file() or not os.path.lexists(target)  # a link in a circle is there, too
    if not (is_file and os.access(folder, os.W_OK)):
        raise UsageError(f"{str(path)!r} cannot be written")
    if any(target == _resolved(given) for given in inputs):
        raise UsageError(
            f"{str(path)!r} is an input and would be lost", remedy="Write to another file"
        )
    return target


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))  # unlike Path.resolve, whatever links there are


def print_json(value: object) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(to_json_text(value))


@contextmanager
def progress(message: str) -> Iterator[Callable[[str], None]]:
    """Say what takes time, on a terminal only.

    What it gives says how far it is: in the same line on a terminal, else a line each on stderr.
    """
    if not stderr.is_terminal:
        yield remark
        return
    # The usual spinner is of Braille, which not every terminal's encoding has.
    spinner = "dots" if is_shown("⠋") else "line"
    with stderr.status(escape(escape_control_chars(message)), spinner=spinner) as status:
        yield lambda text: status.update(escape(escape_control_chars(text)))


def is_shown(text: str) -> bool:
    """Return whether the encodings of both streams have all characters of a text."""
    try:
        for stream in (sys.stdout, sys.stderr):
            text.encode(stream.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True


def say(message: str) -> None:
    """Print one line of the result on stdout; what is in it cannot make a second one."""
    indent = " " * (len(message) - len(message.lstrip(" ")))
    say_lines(indent + escape_control_chars(message))


def say_lines(text: str) -> None:
    """Print a report of several lines on stdout; names in it must be escaped already."""
    stdout.print(text, highlight=False, soft_wrap=True, markup=False)


def remark(message: str) -> None:
    """Print one line on stderr that a user should see, wherever it goes."""
    stderr.print(
        escape_control_chars(message), style="dim", highlight=False, markup=False, soft_wrap=True
    )


@dataclass(frozen=True)
class FootOptions:
    """An emulated foot, as options of a command that is decorated by `with_foot_options`."""

    load: Annotated[
        Path | None, typer.Option(help="Recorded load to press instead of the scene's ground.")
    ] = None
    map_: ColumnsOfReference = None
    units: UnitsOfReference = None
    sign: SignOfReference = None
    rate_hz: RateOfReference = None
    skip_rows: SkipRows = None
    units_row: UnitsRow = None
    decimal: Decimal = None
    encoding: Encoding = None
    load_scale: Annotated[float, typer.Option(help="Factor on every force of the load.")] = 1.0
    cop_scale: Annotated[float, typer.Option(help="Factor on the load's COP about its mean.")] = 1.0
    cop_offset_m: Annotated[
        str, typer.Option(metavar="X,Y", help="Where the load's mean COP comes to lie.")
    ] = "0,0"
    cop_axes: Annotated[
        str, typer.Option(help="Axes of the load that become x and y: xy, yx, -yx, ...")
    ] = "xy"
    lead_s: Annotated[float, typer.Option(help="Seconds without load first: the tare.")] = 1.0
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX, help="Draws noise and ground, not the parts.")
    ] = 0
    parts_seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Draws other parts.")] = 0
    force_plate: Annotated[
        Path | None,
        typer.Option(help="CSV of an emulated force plate under the foot, written at the end."),
    ] = None
    pressure_plate: Annotated[
        Path | None,
        typer.Option(help="Frames (.npz) of an emulated pressure plate, written at the end."),
    ] = None

    def foot(self, scene: Scene) -> EmulatedFoot:
        """What they ask for, in a scene.

        Raises:
            UsageError: options that do not fit, or a number that cannot be meant.
            LoadTraceError: the load is not readable.
        """
        from devices.emulation.ground.load_trace import CopTransform
        from service.rig.emulated_foot import EmulatedFoot
        from storage.formats.load_trace import read_load_trace
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
        plates = self._plates(scene)
        stated = self._stated()
        if self.load is None and stated != ReferenceOptions():
            raise UsageError(
                "what a table does not state itself is stated, and none is named",
                remedy="Add --load FILE",
            )
        if scene.array.bus == EMULATED and scene.ground.kind == "trace" and self.load is None:
            raise UsageError(
                f"scene {scene.name!r} presses a recorded load, and none was given",
                remedy="Add --load FILE",
            )
        offset_m = pair(self.cop_offset_m, "--cop-offset-m") or (0.0, 0.0)
        return EmulatedFoot(
            load=read_load_trace(self.load, stated) if self.load is not None else None,
            load_scale=self.load_scale,
            cop_transform=CopTransform(self.cop_scale, offset_m, self.cop_axes),
            lead_s=self.lead_s,
            seed=self.seed,
            parts_seed=self.parts_seed,
            plates=plates,
        )

    def _stated(self) -> ReferenceOptions:
        from storage.formats.reference import ReferenceOptions

        of_text: dict[str, str | float | None] = {
            "skip_rows": self.skip_rows,
            "units_row": self.units_row,
            "decimal": self.decimal,
            "encoding": self.encoding,
        }
        return ReferenceOptions(
            named_values(self.map_, "--map"),
            named_values(self.units, "--units"),
            self.sign,
            self.rate_hz,
            text_stated(of_text),
        )

    def _plates(self, scene: Scene) -> PlateFiles:
        from devices.emulation.plates.plate_load import check_plate_usable
        from service.rig.plate_files import PlateFiles

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
            output_path(path)
            check_plate_usable(name, scene)
        return PlateFiles(self.force_plate, self.pressure_plate)

    def as_arguments(self) -> list[str]:
        """The same options for another command."""
        values = {f.name.replace("_", "-"): getattr(self, f.name) for f in fields(self)}
        return [f"--{name}={value}" for name, value in values.items() if value is not None]


def with_foot_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameter `options`, a `FootOptions`, is an option for each of its fields."""
    own = inspect.signature(command, eval_str=True)
    of_foot = inspect.signature(FootOptions, eval_str=True).parameters

    @wraps(command)
    def run(**given: Any) -> None:
        options = FootOptions(**{name: given.pop(name) for name in of_foot})
        command(**given, options=options)

    parameters = [p for p in own.parameters.values() if p.name != "options"] + [*of_foot.values()]
    run.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]  # for typer
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def with_finite_numbers(command: Callable[..., None]) -> Callable[..., None]:
    """A command that refuses NaN and infinity in any of its options: no option means them."""

    @wraps(command)
    def run(**given: Any) -> None:
        for name, value in given.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise UsageError(
                    f"--{name.replace('_', '-')} {value:g}", expected="a finite number"
                )
        command(**given)

    return run


def check_emulated(scene: Scene) -> None:
    """Refuse a scene of real hardware in a command that only emulates.

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


def scene_with(name: str, *, bus: str | None, servo: str | None) -> Scene:
    """A scene, on another bus or with its servo elsewhere if that is asked for.

    Raises:
        SceneError: no such scene.
        UsageError: a servo's port for a scene without servo.
    """
    scene = load_scene(name)
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


def stop_on_signals() -> asyncio.Event:
    """An event that Ctrl-C or SIGTERM sets, in the running loop."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    return stop
