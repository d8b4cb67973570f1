"""Force platforms of a C3D file, types 1 to 4, read by ezc3d.

Forces are those of the ground on the foot, upwards: a plate's own z axis points down, and what it
measures is what bears on it (C3D manual, FORCE_PLATFORM). Centres of pressure are in the axes of
the laboratory, as corners are. What a plate reads of nothing is not taken off: the comparison tells
it.

ezc3d crashes, or never ends, over some files that are damaged: it runs in a process of its own.
"""

from __future__ import annotations

import multiprocessing
import resource
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError, needs_extra
from devices.inputs import check_file
from storage.formats.reference_tables import NUMBERS_MAX, TEXT_BYTES_MAX, Table

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_FORCES = {1: range(3), 2: range(3), 3: range(8)}
"""Which channels of a plate are forces, by its type. Those of type 4 are volts, or anything; in
which units its matrix makes forces of them the file does not say."""
_MOMENTS = {2: range(3, 6)}
"""Of which the centre of pressure is made."""
_OURS = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
_PATIENCE_S = 60.0
_MEMORY_BYTES_MAX = 8 << 30


@dataclass(frozen=True)
class Plate:
    """One of a file, in the file's units and the axes of the laboratory; n samples.

    Attributes:
        kind: its type.
        fz: (n,), upwards what bears on it.
        cop: (2, n).
        position: unit of positions.
        channels: units of its channels.
    """

    kind: int
    fz: Floats
    cop: Floats
    position: str
    channels: tuple[str, ...]

    @property
    def knows_forces(self) -> bool:
        """Does the file say that its forces are newtons?"""
        at = _FORCES.get(self.kind, range(0))
        return len(at) > 0 and all(self.channels[i : i + 1] == ("N",) for i in at)

    @property
    def knows_cop(self) -> bool:
        """Does it say in which unit the centre of pressure comes out?"""
        products = {(f"N{point}{self.position}",) for point in ("", "*", ".")}
        moments = _MOMENTS.get(self.kind, range(0))
        is_right = all(self.channels[i : i + 1] in products for i in moments)
        return self.knows_forces and is_right and self.position in _METRES


@dataclass(frozen=True)
class Content:
    """What is needed of a file: analog samples a second and a frame, its plates and their zero."""

    rate_hz: float
    samples_a_frame: int
    plates: tuple[Plate, ...]
    zero: tuple[int, ...]


def read_force_platforms(path: Path) -> Table:
    """Force and centre of pressure of each plate, of analog samples.

    Columns are `plate1_fz`, `plate1_cop_x`, `plate1_cop_y` and so on, in SI units where the file
    says in which units its channels are, else as they are; those of a single plate that says it
    have our own names as well.

    Raises:
        MissingExtraError: ezc3d is not installed.
        FileFormatError: unreadable, without a plate, or of a type that is not known.
    """
    where = str(path)
    content = _read(path)
    columns: dict[str, Floats] = {}
    known = {"time_s"}
    for number, plate in enumerate(content.plates, start=1):
        names = [f"plate{number}_{name}" for name in ("fz", "cop_x", "cop_y")]
        cop = plate.cop * (_METRES[plate.position] if plate.knows_cop else 1.0)
        cop[:, ~np.isfinite(cop).all(axis=0)] = np.nan
        columns |= dict(zip(names, (plate.fz, *cop), strict=True))
        known |= {*names[: 1 if plate.knows_forces else 0]}
        known |= {*names[1 : 3 if plate.knows_cop else 1]}
    if not columns:
        raise FileFormatError(
            "there is no force platform in it", where=where, expected="FORCE_PLATFORM:USED of 1"
        )
    if not (np.isfinite(content.rate_hz) and content.rate_hz > 0.0):
        raise FileFormatError(f"ANALOG:RATE is {content.rate_hz:g}", where=where)
    columns["time_s"] = np.arange(len(columns["plate1_fz"])) / content.rate_hz
    if len(content.plates) == 1:
        for ours, theirs in _OURS.items():
            if theirs in known:
                columns[ours] = columns[theirs]
                known.add(ours)
    return Table(where, tuple(columns), columns, frozenset(known), notes=_notes(content))


def _notes(content: Content) -> tuple[str, ...]:
    notes = []
    if len(content.zero) == 2 and 1 <= content.zero[0] <= content.zero[1]:
        first, last = content.zero
        window = slice((first - 1) * content.samples_a_frame, last * content.samples_a_frame)
        read = [plate.fz[window] for plate in content.plates]
        said = ", ".join(f"{fz.mean():.3f}" for fz in read if len(fz))
        notes.append(
            f"frames {first} to {last} are to be its zero, in which plates read {said}: nothing is "
            "taken off"
        )
    if len(content.plates) > 1:
        notes.append(f"there are {len(content.plates)} plates: --map says which one")
    return tuple(notes)


def _read(path: Path) -> Content:
    where = str(path)
    with needs_extra("mocap", "a C3D file"):
        import ezc3d  # noqa: F401  # in the other process it is too late to say that it is missing
    try:
        # Every number in it takes two bytes at least.
        check_file(path, bytes_max=min(TEXT_BYTES_MAX, 2 * NUMBERS_MAX))
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error}", where=where) from error
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_extract, args=(path, theirs), daemon=True)
    process.start()
    theirs.close()
    found: Content | str = "it takes too long to be read"
    try:
        if ours.poll(_PATIENCE_S):
            found = ours.recv()
    except (EOFError, OSError):
        found = "what reads it has crashed over it"
    finally:
        process.kill()
        process.join()
        ours.close()
    if isinstance(found, Content):
        return found
    raise FileFormatError(
        f"no force platforms of C3D: {found}", where=where, expected="a whole file, types 1 to 4"
    )


def _extract(path: Path, connection: Connection) -> None:
    """Body of the other process: says what is in the file, or what is wrong with it."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES_MAX, _MEMORY_BYTES_MAX))
    try:
        said: Content | str = _content(path)
    except Exception as error:
        said = f"{type(error).__name__}: {error}"[:200]
    with suppress(OSError):
        connection.send(said)


def _content(path: Path) -> Content:
    import ezc3d

    whole: Any = ezc3d.c3d(str(path), extract_forceplat_data=True)
    points, analog = whole["parameters"]["POINT"], whole["parameters"]["ANALOG"]
    about = whole["parameters"]["FORCE_PLATFORM"] if whole["data"]["platform"] else {}
    plates = []
    for number, plate in enumerate(whole["data"]["platform"]):
        channels = np.asarray(about["CHANNEL"]["value"])[:, number].astype(int)
        units = analog["UNITS"]["value"] if "UNITS" in analog else []
        plates.append(
            Plate(
                kind=int(about["TYPE"]["value"][number]),
                fz=-np.asarray(plate["force"][2], dtype=np.float64),
                cop=np.array(plate["center_of_pressure"][:2], dtype=np.float64),
                position=str(plate["unit_position"]),
                channels=tuple(units[at - 1].strip() for at in channels if 0 < at <= len(units)),
            )
        )
    rate_hz = float(analog["RATE"]["value"][0])
    zero = np.ravel(about["ZERO"]["value"]) if "ZERO" in about else ()
    return Content(
        rate_hz=rate_hz,
        samples_a_frame=max(1, round(rate_hz / float(points["RATE"]["value"][0]))),
        plates=tuple(plates),
        zero=tuple(int(frame) for frame in zero),
    )
