"""C3D writer: the foot as a force platform of type 2, in the foot frame, written by ezc3d.

The laboratory has the axes of the foot frame, in mm. The platform's z points down, as the C3D
manual requires (FORCE_PLATFORM), so its y is opposite to the foot's. Its channels are the reaction
on the foot, as Vicon, Qualisys and most others write it: Fz is the negative GRF, Mx and My are Fz
times the centre of pressure. Known to be without contact they are 0, and there is no centre of
pressure; unknown numbers are NaN.

Integers have to be integer arrays: ezc3d writes a list of integers as floats, and then cannot read
the file.
"""

from __future__ import annotations

import tempfile
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from threading import Semaphore
from typing import Any, NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FootTileError, StorageError
from devices.frames import TileInfo
from storage.formats.export import Export
from storage.formats.writers.format import (
    ExportFormat,
    format_largest_clock_bound,
    format_metadata,
    to_ascii_line,
)
from storage.formats.writers.resampling import (
    OPTIONAL_COLUMNS,
    GroundReaction,
    read_reactions_on_common_axis,
)
from storage.schema import COLUMNS_BY_NAME

FRAMES_MAX = 2_000_000
"""Limit of frames: an hour at 544 Hz."""
NUMBERS_MAX = 50_000_000
"""Limit of samples times channels in memory, at some 40 bytes each."""
C3D_FRAMES_MAX = 32_767
"""Limit of C3D frames in older readers; more samples are grouped into frames."""
EVENTS_MAX = 255
"""Limit of entries of a list in C3D."""
MARGIN_MM = 10.0
"""Margin of the platform around the rectangle of the tiles' positions."""

_PLATFORM_CHANNELS = {
    "Fx": ("N", "not measured, 0"),
    "Fy": ("N", "not measured, 0"),
    "Fz": ("N", "GRF on the foot, negative: z points down; 0 without contact"),
    "Mx": ("Nmm", "Fz times COP, at the platform's centre; NaN where no COP is stated"),
    "My": ("Nmm", "Fz times COP, at the platform's centre; NaN where no COP is stated"),
    "Mz": ("Nmm", "not measured, 0"),
}
_UNCERTAINTY = "t_server_uncertainty_s"
_CONTEXTS_BY_NODE = {"left": "Left", "right": "Right"}
"""Contexts of events after the C3D manual, by name of the node."""
_CHUNK_BYTES = 1 << 20
_TEXT_MAX = 100
_WRITER_LOCK = Semaphore()
"""Lock of the writer: an hour of frames needs a gigabyte of memory."""

ParameterGroups = Mapping[str, Mapping[str, Any]]
Channel = tuple[str, str, str, Floats]
"""Label, unit, description, samples."""


def _encode(exports: Sequence[Export]) -> Iterator[bytes]:
    import ezc3d  # noqa: F401  # fails before anything is read if it is not installed

    try:
        with tempfile.TemporaryDirectory(prefix="foottile-") as folder:
            path = Path(folder) / "session.c3d"
            with _WRITER_LOCK:
                _save(path, *_read_content(exports))
            with path.open("rb") as file:
                while piece := file.read(_CHUNK_BYTES):
                    yield piece
    except FootTileError:
        raise
    except MemoryError as error:
        raise StorageError(
            "there is not enough memory to write it",
            remedy="Lift the limit (ulimit -v), or ask for a slice",
        ) from error
    except (RuntimeError, ValueError) as error:  # messages of ezc3d do not help the user
        raise StorageError(
            "ezc3d cannot write it", remedy="Ask for a slice, or for another format"
        ) from error
    except OSError as error:
        raise StorageError(
            f"cannot be written: {error}",
            where=tempfile.gettempdir(),
            remedy="Make room there, or name another place in TMPDIR",
            errno=error.errno,
        ) from error


class C3dContent(NamedTuple):
    """Parameters by group and name, and analog samples (channels, n)."""

    groups: ParameterGroups
    samples: Floats


def _read_content(exports: Sequence[Export]) -> C3dContent:
    tiles = sum(len(_load_bearing_tiles(export)) for export in exports)
    width = len(exports) * (len(_PLATFORM_CHANNELS) + len(OPTIONAL_COLUMNS) + 4) + tiles
    frames_max = min(FRAMES_MAX, NUMBERS_MAX // width)
    return build_c3d_content(
        read_reactions_on_common_axis(exports, [*OPTIONAL_COLUMNS, "force_n"], frames_max), exports
    )


def build_c3d_content(reactions: Sequence[GroundReaction], exports: Sequence[Export]) -> C3dContent:
    """Build the content of a C3D file.

    Values are arrays or lists of integers, floats or texts; the last dimension changes slowest in
    the file, as in the manual.

    Args:
        reactions: ground reactions on one time axis, one for each export.
        exports: exports of the sessions.
    """
    platforms = [_platform_geometry(export) for export in exports]
    channels = _list_channels(reactions, exports, [centre_m for centre_m, _ in platforms])
    samples = len(reactions[0].resampling)
    per_frame = -(-samples // C3D_FRAMES_MAX)
    filling = -samples % per_frame
    analog = np.full((len(channels), samples + filling), np.nan)
    for row, (*_, values) in zip(analog, channels, strict=True):
        row[:samples] = values
    rate_hz = reactions[0].resampling.axis.rate_hz
    groups: dict[str, dict[str, Any]] = {
        "POINT": {
            "RATE": [rate_hz / per_frame],
            "UNITS": ["mm"],
            "X_SCREEN": ["+X"],
            "Y_SCREEN": ["+Z"],
        },
        "ANALOG": {
            "RATE": [rate_hz],
            "LABELS": [label for label, *_ in channels],
            "DESCRIPTIONS": [to_ascii_line(text)[:_TEXT_MAX] for _, _, text, _ in channels],
            "UNITS": [unit for _, unit, *_ in channels],
            "GEN_SCALE": [1.0],
            "SCALE": np.ones(len(channels)),
            "OFFSET": np.zeros(len(channels), dtype=np.int64),
        },
        "FORCE_PLATFORM": {
            "USED": np.array([len(reactions)]),
            "TYPE": np.full(len(reactions), 2),
            "ZERO": np.array([1, 0]),
            "CORNERS": np.stack([corners_mm.T for _, corners_mm in platforms], axis=2),
            "ORIGIN": np.zeros((3, len(reactions))),
            "CHANNEL": np.arange(1, 6 * len(reactions) + 1).reshape(len(reactions), 6).T,
        },
        "EVENT": _event_parameters(reactions, exports),
        "MANUFACTURER": {
            "COMPANY": ["FootTile"],
            "SOFTWARE": [to_ascii_line(exports[0].array_info.software)[:_TEXT_MAX]],
        },
    }
    for number, (reaction, export) in enumerate(zip(reactions, exports, strict=True), 1):
        texts = _metadata_texts(
            reaction, export, filling, sum(len(each.events) for each in reactions)
        )
        wrapped = {name: textwrap.wrap(text, _TEXT_MAX) or [" "] for name, text in texts.items()}
        groups["FOOTTILE" + (str(number) if len(reactions) > 1 else "")] = wrapped
    return C3dContent(groups, analog)


def _list_channels(
    reactions: Sequence[GroundReaction], exports: Sequence[Export], centres_m: Sequence[Floats]
) -> list[Channel]:
    """List the analog channels: those of all force platforms, then each session's others."""
    channels: list[Channel] = []
    for number, (reaction, centre_m) in enumerate(zip(reactions, centres_m, strict=True), 1):
        named = zip(_PLATFORM_CHANNELS.items(), _platform_signals(reaction, centre_m), strict=True)
        channels += [(f"{name}{number}", *about, values) for (name, about), values in named]
    for number, (reaction, export) in enumerate(zip(reactions, exports, strict=True), 1):
        prefix = f"{number}:" if len(reactions) > 1 else ""
        for label, unit, text, values in _extra_channels(reaction, export):
            channels.append((prefix + label, unit, text, values))
    return channels


def _metadata_texts(
    reaction: GroundReaction, export: Export, filling: int, events: int
) -> dict[str, str]:
    contact_count = len(reaction.events) - reaction.marker_count
    text = f"{reaction.marker_count} markers, {contact_count} begins and ends of contact"
    if events > EVENTS_MAX:
        text += (
            f"; the last {events - EVENTS_MAX} are left out, {EVENTS_MAX} being the most: see "
            "channel contact"
        )
    texts = {
        **format_metadata(export, reaction.resampling.axis.begin_ns),
        "AXES": "the foot frame: x forward, y to the left, z up the segment, origin at the ankle; "
        "the platform moves with the foot",
        "RESAMPLED": reaction.resampling.describe(),
        "FILLED": f"no number; at the end {filling} samples, NaN, fill the last frame"
        if filling
        else "nothing",
        "MASKED": "NaN: no frame, a saturated or missing tile, or no COP stated while in contact; "
        "estimate_flags says which, grf_lower_bound_n is a lower bound. Without contact Fz, Mx and "
        "My are 0, and grf_n is what was measured",
        "SHEAR": "not measured: Fx, Fy and Mz are 0",
        "EVENTS": text,
    }
    return texts | format_largest_clock_bound(reaction.server_time_bound_s)


def _extra_channels(reaction: GroundReaction, export: Export) -> Iterator[Channel]:
    for name in ("grf_n", *OPTIONAL_COLUMNS, "contact", "estimate_flags"):
        if name in reaction.columns:
            yield (
                name,
                COLUMNS_BY_NAME[name].unit,
                COLUMNS_BY_NAME[name].description,
                reaction.resample_column(name),
            )
    if reaction.server_time_bound_s is not None:
        about = "bound of the time of the frames by the server's clock"
        yield _UNCERTAINTY, "s", about, reaction.server_time_bound_s
    for i, tile in _load_bearing_tiles(export).items():
        if f"force_n_{i}" in reaction.columns:
            x_mm, y_mm, z_mm = (1e3 * place for place in (tile.x_m, tile.y_m, tile.z_m))
            place = f"at {x_mm:g}, {y_mm:g}, {z_mm:g} mm"
            text = f"force along its axis on tile {tile.serial} {place}"
            yield f"force_n_{i}", "N", text, reaction.resample_column(f"force_n_{i}")


def _event_parameters(
    reactions: Sequence[GroundReaction], exports: Sequence[Export]
) -> dict[str, Any]:
    markers: list[tuple[float, str, str]] = []
    contacts: list[tuple[float, str, str]] = []
    for reaction, export in zip(reactions, exports, strict=True):
        node = export.array_info.node
        named = to_ascii_line(node)[:_TEXT_MAX] if len(reactions) > 1 else "General"
        context = _CONTEXTS_BY_NODE.get(node.lower(), named)
        events = [(at_s, context, label) for at_s, label in reaction.events]
        markers += events[: reaction.marker_count]
        contacts += events[reaction.marker_count :]
    written = [*sorted(markers), *sorted(contacts)][:EVENTS_MAX]
    return {
        "USED": np.array([len(written)]),
        "CONTEXTS": [context or "General" for _, context, _ in written],
        "LABELS": [to_ascii_line(label)[:_TEXT_MAX] or "marker" for _, _, label in written],
        "DESCRIPTIONS": [" "] * len(written),
        "TIMES": np.array([divmod(at_s, 60.0) for at_s, *_ in written]).reshape(-1, 2).T,
    }


def _load_bearing_tiles(export: Export) -> dict[int, TileInfo]:
    """Return the load-bearing tiles by number."""
    return {i: tile for i, tile in enumerate(export.array_info.tiles) if not tile.reference}


def _platform_geometry(export: Export) -> tuple[Floats, Floats]:
    """Return the platform's centre in the foot frame, (3,) in m, and its corners, (4, 3) in mm.

    Corners are in the order of the manual: quadrants +x +y, -x +y, -x -y, +x -y of the platform's
    axes; its y and z are opposite to the foot's.
    """
    places = np.array([(t.x_m, t.y_m, t.z_m) for t in _load_bearing_tiles(export).values()])
    low, high = places.min(axis=0) * 1e3 - MARGIN_MM, places.max(axis=0) * 1e3 + MARGIN_MM
    z_mm = float(places[:, 2].mean()) * 1e3
    corners_mm = np.array(
        [
            (high[0], low[1], z_mm),
            (low[0], low[1], z_mm),
            (low[0], high[1], z_mm),
            (high[0], high[1], z_mm),
        ]
    )
    return corners_mm.mean(axis=0) * 1e-3, corners_mm


def _platform_signals(reaction: GroundReaction, centre_m: Floats) -> Iterator[Floats]:
    """Yield Fx, Fy, Fz, Mx, My and Mz on the foot in the platform's axes, (n,) in N and N mm."""
    fz_n = 0.0 - reaction.frame_contact_grf_n
    fz = reaction.resampling.interpolate(fz_n)
    nothing = np.where(np.isnan(fz), np.nan, 0.0)
    yield from (nothing, nothing, fz)
    for at in (1, 0):  # r x F; the platform's y is opposite to the foot's
        along_m = reaction.columns[f"cop_{'xy'[at]}_m"].astype(np.float64) - centre_m[at]
        moment = np.where(reaction.is_frame_unloaded, 0.0, -1e3 * along_m * fz_n)
        yield reaction.resampling.interpolate(moment)
    yield nothing


def _save(path: Path, groups: ParameterGroups, analog: Floats) -> None:
    """Write the file and check its size: ezc3d does not report a full disk."""
    import ezc3d

    file = ezc3d.c3d()
    parameters = file["parameters"]
    for group, values in groups.items():
        if group not in parameters:
            file.add_parameter(group, "USED", 0)
            del parameters[group]["USED"]
        for name, value in values.items():
            parameters[group][name] = _make_parameter(ezc3d.ezc3d, value)
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


def _make_parameter(types: Any, value: Sequence[Any] | np.ndarray) -> dict[str, Any]:
    if isinstance(value, np.ndarray):
        type_ = types.INT if value.dtype.kind == "i" else types.FLOAT
    else:
        type_ = types.CHAR if value and isinstance(value[0], str) else types.FLOAT
    return {"type": type_, "description": "", "is_locked": False, "value": value}


C3D = ExportFormat(
    "c3d",
    "C3D",
    "C3D programs (tried: ezc3d, c3d)",
    "application/octet-stream",
    _encode,
    group_encoder=_encode,
    takes_columns=False,
    needs_forces=True,
    frames_max=FRAMES_MAX,
    extra="mocap",
    packages=("ezc3d",),
)
