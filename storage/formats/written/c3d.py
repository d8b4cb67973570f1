"""C3D: the foot as a force platform of type 2, in its own frame, written by ezc3d.

The laboratory's axes are those of the foot frame, in mm. The platform's own z points down, as the
C3D manual wants it (FORCE_PLATFORM), so its y is the foot's turned; its channels are what the foot
does to it: Fz is the GRF, Mx and My are the GRF times the centre of pressure, so that a reader
comes to both again. While the foot is known to bear nothing they are 0, and there is no centre of
pressure; where something is not known, it is NaN.

Integers have to be integers: ezc3d makes floats of a list of them, and then does not read the file.
"""

from __future__ import annotations

import tempfile
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.errors import StorageError
from storage.formats.export import Export
from storage.formats.written.described import ascii_of, described
from storage.formats.written.format import Format
from storage.formats.written.reaction import FURTHER, Reaction, reaction_of
from storage.schema import KNOWN

FRAMES_MAX = 2_000_000
"""An hour at 544 Hz."""
NUMBERS_MAX = 40_000_000
"""Samples times channels that are kept in memory, at some 40 bytes each."""
C3D_FRAMES_MAX = 32_767
"""Older readers know no more; several samples make one frame then."""
EVENTS_MAX = 255
"""Entries of a list in C3D."""
MARGIN_MM = 10.0
"""By which the platform is larger than the rectangle of the tiles' places."""

_CHANNELS = {
    **{"Fx1": ("N", "not measured, 0"), "Fy1": ("N", "not measured, 0")},
    "Fz1": ("N", "GRF, down on the platform; 0 without contact"),
    "Mx1": ("Nmm", "GRF times COP, at the platform's centre; NaN where no COP is stated"),
    "My1": ("Nmm", "GRF times COP, at the platform's centre; NaN where no COP is stated"),
    "Mz1": ("Nmm", "not measured, 0"),
}
_PIECE = 1 << 20
_TEXT = 100


def _write(export: Export) -> Iterator[bytes]:
    import ezc3d  # noqa: F401  # if it is not installed, that is said before anything is read

    tiles = [i for i, tile in enumerate(export.info.tiles) if not tile.reference]
    wanted = [*FURTHER, "force_n"]
    frames_max = min(FRAMES_MAX, NUMBERS_MAX // (len(_CHANNELS) + len(FURTHER) + len(tiles) + 3))
    found = reaction_of(export, wanted, frames_max)
    groups, analog = c3d_content(found, export)
    try:
        with tempfile.TemporaryDirectory(prefix="foottile-") as folder:
            path = Path(folder) / "session.c3d"
            _save(path, groups, analog)
            del analog
            with path.open("rb") as file:
                while piece := file.read(_PIECE):
                    yield piece
    except OSError as error:
        raise StorageError(
            f"cannot be written: {error}",
            where=tempfile.gettempdir(),
            remedy="Make room there, or name another place in TMPDIR",
            errno=error.errno,
        ) from error


Groups = Mapping[str, Mapping[str, Any]]


def c3d_content(found: Reaction, export: Export) -> tuple[dict[str, dict[str, Any]], Floats]:
    """Parameters by group and name, and analog samples, (channels, n).

    Integers, floats and texts are arrays or lists of these; the last dimension is that which
    changes slowest in the file, as in the manual.
    """
    centre_m, corners_mm = _platform(export)
    channels = dict(_CHANNELS)
    rows = list(_wrench(found, centre_m))
    for name in ("grf_n", *FURTHER, "contact", "estimate_status"):
        if name in found.columns:
            about = KNOWN[name]
            channels[name] = about.unit, about.description
            rows.append(found.at(name))
    for i, tile in enumerate(export.info.tiles):
        name = f"force_n_{i}"
        if name in found.columns and not tile.reference:
            x_mm, y_mm, z_mm = (1e3 * place for place in (tile.x_m, tile.y_m, tile.z_m))
            place = f"at {x_mm:g}, {y_mm:g}, {z_mm:g} mm"
            channels[name] = "N", f"force along its axis on tile {tile.serial} {place}"
            rows.append(found.at(name))
    per_frame = -(-len(rows[0]) // C3D_FRAMES_MAX)
    filling = -len(rows[0]) % per_frame
    analog = np.full((len(rows), len(rows[0]) + filling), np.nan)
    analog[:, : len(rows[0])] = rows
    rate_hz = found.steady.rate_hz
    events = found.events[:EVENTS_MAX]
    said = {
        **described(export, found.steady.begin_ns),
        "AXES": "the foot frame: x forward, y to the left, z up the segment, origin at the ankle; "
        "the platform moves with the foot",
        "TIME_BASE": found.steady.says()
        + (f"; the last {filling} samples fill the last frame: NaN" if filling else ""),
        "UNKNOWN": "NaN: no frame, a saturated or missing tile, or no COP stated while in contact; "
        "estimate_status says which, grf_at_least_n is a lower bound",
        "SHEAR": "not measured: Fx1, Fy1 and Mz1 are 0",
        "EVENTS": _of_events(found),
    }
    groups: dict[str, dict[str, Any]] = {
        "POINT": {"RATE": [rate_hz / per_frame], "UNITS": ["mm"], "X_SCREEN": ["+X"]}
        | {"Y_SCREEN": ["+Z"]},
        "ANALOG": {
            "RATE": [rate_hz],
            "LABELS": list(channels),
            "DESCRIPTIONS": [ascii_of(text)[:_TEXT] for _, text in channels.values()],
            "UNITS": [unit for unit, _ in channels.values()],
            "GEN_SCALE": [1.0],
            "SCALE": np.ones(len(rows)),
            "OFFSET": np.zeros(len(rows), dtype=np.int64),
        },
        "FORCE_PLATFORM": {
            "USED": np.array([1]),
            "TYPE": np.array([2]),
            "ZERO": np.array([1, 0]),
            "CORNERS": corners_mm.T.reshape(3, 4, 1),
            "ORIGIN": np.zeros((3, 1)),
            "CHANNEL": np.arange(1, 7).reshape(6, 1),
        },
        "EVENT": {
            "USED": np.array([len(events)]),
            "CONTEXTS": ["General"] * len(events),
            "LABELS": [ascii_of(label)[:_TEXT] or "mark" for _, label in events],
            "DESCRIPTIONS": [" "] * len(events),
            "TIMES": np.array([divmod(at_s, 60.0) for at_s, _ in events]).reshape(-1, 2).T,
        },
        "MANUFACTURER": {"COMPANY": ["FootTile"], "SOFTWARE": [said["SOFTWARE"][:_TEXT]]},
        "FOOTTILE": {name: textwrap.wrap(text, _TEXT) or [" "] for name, text in said.items()},
    }
    return groups, analog


def _platform(export: Export) -> tuple[Floats, Floats]:
    """Its centre in the foot frame, (3,) in m, and its corners, (4, 3) in mm.

    In the order of the manual: the quadrants +x +y, -x +y, -x -y, +x -y of its own axes, of which y
    and z are the foot's turned.
    """
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in export.info.tiles if not t.reference])
    low, high = places.min(axis=0) * 1e3 - MARGIN_MM, places.max(axis=0) * 1e3 + MARGIN_MM
    z_mm = float(places[:, 2].mean()) * 1e3
    corners = [
        *((high[0], low[1], z_mm), (low[0], low[1], z_mm)),
        *((low[0], high[1], z_mm), (high[0], high[1], z_mm)),
    ]
    corners_mm = np.array(corners)
    return corners_mm.mean(axis=0) * 1e-3, corners_mm


def _wrench(found: Reaction, centre_m: Floats) -> Iterator[Floats]:
    """What the foot does to the platform, in the platform's axes: N and N mm, (n,) each."""
    fz_n = found.grf_n
    fz = found.steady.between(fz_n)
    nothing = np.where(np.isnan(fz), np.nan, 0.0)
    yield from (nothing, nothing, fz)
    for at in (1, 0):  # r x F, the platform's y being the foot's turned
        along_m = found.columns[f"cop_{'xy'[at]}_m"].astype(np.float64) - centre_m[at]
        moment = np.where(found.is_unloaded, 0.0, -1e3 * along_m * fz_n)
        yield found.steady.between(moment)
    yield nothing


def _of_events(found: Reaction) -> str:
    text = f"{found.marks} marks, {len(found.events) - found.marks} begins and ends of contact"
    over = len(found.events) - EVENTS_MAX
    if over > 0:
        text += f"; the last {over} are left out, {EVENTS_MAX} being the most: see channel contact"
    return text


def _save(path: Path, groups: Groups, analog: Floats) -> None:
    """Have it written, and see to it that it is whole: ezc3d does not say if the disk was full."""
    import ezc3d

    file = ezc3d.c3d()
    parameters = file["parameters"]
    for group, values in groups.items():
        if group not in parameters:
            file.add_parameter(group, "USED", 0)
            del parameters[group]["USED"]
        for name, value in values.items():
            parameters[group][name] = _parameter(ezc3d.ezc3d, value)
    per_frame = -(-analog.shape[1] // C3D_FRAMES_MAX)
    file["data"]["points"] = np.zeros((4, 0, analog.shape[1] // per_frame))
    file["data"]["analogs"] = analog[None]
    file.write(str(path))
    with path.open("rb") as written:
        head = written.read(512)
        begin = 512 * (int.from_bytes(head[16:18], "little") - 1)
    size = path.stat().st_size
    if size < begin + 4 * analog.size:
        raise OSError(f"{size} bytes of {begin + 4 * analog.size} were written")


def _parameter(types: Any, value: Sequence[Any] | np.ndarray) -> dict[str, Any]:
    if isinstance(value, np.ndarray):
        type_ = types.INT if value.dtype.kind == "i" else types.FLOAT
    else:
        type_ = types.CHAR if value and isinstance(value[0], str) else types.FLOAT
    return {"type": type_, "description": "", "is_locked": False, "value": value}


C3D = Format(
    "c3d",
    "C3D",
    "Visual3D, Mokka, QTM, Vicon",
    "application/octet-stream",
    _write,
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
    extra="mocap",
    packages=("ezc3d",),
)
