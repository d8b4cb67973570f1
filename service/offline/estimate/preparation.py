"""Resolution of an estimate request for a session: array, calibration, models and tares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from devices.errors import CalibrationError, FileFormatError, TareError, UsageError
from devices.frames import ArrayInfo
from devices.scene.emulation_sections import PartFamily
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.offline.calibration_lookup import EMULATED_RIG, find_calibration
from service.offline.estimate.request import EstimateRequest
from service.sessions.pipeline import EstimateOptions
from storage.schema import INDENTER_COLUMNS, PART_COLUMNS, TRUTH_COLUMNS
from storage.sessions.reader import SealedFileReader


@dataclass(frozen=True)
class PreparedEstimate:
    """Resolved request for one session.

    Attributes:
        info: its array, with the requested tile positions.
        options: options of the estimate.
        kept_columns: columns of the session, beside the frames, that are copied unchanged.
    """

    info: ArrayInfo
    options: EstimateOptions
    kept_columns: tuple[str, ...]


def prepare_estimate(
    session: SealedFileReader, request: EstimateRequest, on_remark: Callable[[str], None]
) -> PreparedEstimate:
    """Resolve a request for a session.

    Raises:
        FootTileError: scene or calibration do not fit the session.
    """
    scene, info = request.scene, _place_tiles(session.info, request.scene)
    options = EstimateOptions(
        calibration=_find_calibration(session, scene, request.calibration, on_remark),
        models=request.models or (scene.models if scene else info.models),
        lag_ms=request.lag_ms,
        tare_s=request.tare_s,
        tares=_read_tares(session) if request.tare_s is None else (),
        exact=request.exact,
    )
    kept = tuple(
        c.name
        for c in (*PART_COLUMNS, *TRUTH_COLUMNS, *INDENTER_COLUMNS)
        if session.has_columns(c.name)
    )
    return PreparedEstimate(info, options, kept)


def _read_tares(session: SealedFileReader) -> tuple[Tare, ...]:
    """Read the tares recorded in the session, oldest first."""
    recorded = session.notes.get("tares", [])
    tiles = len(session.info.tiles)
    try:
        return tuple(Tare.from_dict(content, tiles=tiles) for content in recorded)
    except (TareError, TypeError) as error:
        raise FileFormatError(
            f"its tares are not readable: {error}",
            where=str(session.path),
            remedy="Name an unloaded interval with --tare-s BEGIN,END",
        ) from error


def _place_tiles(info: ArrayInfo, scene: Scene | None) -> ArrayInfo:
    """Return the array with the scene's tile positions."""
    if scene is None:
        return info
    places = {tile.serial: tile for tile in scene.tile}
    if set(places) != set(info.serials):
        raise UsageError(
            f"scene {scene.name!r} has the tiles {', '.join(sorted(places))}, "
            f"the session {', '.join(sorted(info.serials))}",
            remedy="Name the scene it was recorded with",
        )
    tiles = tuple(
        tile.model_copy(
            update={
                name: getattr(places[tile.serial], name)
                for name in ("x_m", "y_m", "z_m", "reference")
            }
        )
        for tile in info.tiles
    )
    return info.model_copy(update={"tiles": tiles})


def _find_calibration(
    session: SealedFileReader,
    scene: Scene | None,
    wanted: str | Calibration | None,
    remark: Callable[[str], None],
) -> Calibration:
    notes = session.notes
    where = str(session.path)
    serials = [tile.serial for tile in session.info.tiles if not tile.reference]
    if isinstance(wanted, Calibration):
        wanted.get_tiles(serials)
        return wanted
    inside = None
    if "calibration" in notes:
        try:
            inside = Calibration.model_validate(notes["calibration"])
        except ValueError as error:
            if wanted is None:
                raise FileFormatError(
                    f"its calibration is not readable: {error}", where=where
                ) from error
    if inside is not None and wanted in (None, inside.id):
        return inside
    name = wanted or (scene.calibration if scene is not None else None)
    if name is None:
        raise CalibrationError(
            "no calibration: the session brings none and none was named",
            where=where,
            remedy="Add --calibration FILE, or --scene with a scene that names one",
        )
    if name == EMULATED_RIG and "parts_seed" not in notes:
        # The emulated rig would calibrate an emulated tile of the same serial: plausible and wrong.
        raise CalibrationError(
            "the emulated rig calibrates emulated tiles only, and this session has real ones",
            where=where,
            remedy="Load the tiles on a real rig and run `foottile calibrate`",
        )
    return find_calibration(
        name,
        serials,
        parts_seed=int(notes.get("parts_seed", 0)),
        family=_read_family(notes),
        on_progress=remark,
    )


def _read_family(notes: Mapping[str, Any]) -> PartFamily:
    """Return the part family of an emulated session; "default" if none is recorded."""
    scene = notes.get("scene")
    emulation = scene.get("emulation") if isinstance(scene, dict) else None
    named = emulation.get("family") if isinstance(emulation, dict) else None
    families: tuple[PartFamily, ...] = get_args(PartFamily)
    return next((family for family in families if family == named), "default")
