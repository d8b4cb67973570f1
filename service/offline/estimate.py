"""A sealed session in, the same session with new estimates out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from devices.errors import CalibrationError, FileFormatError, TareError, UsageError
from devices.frames import ArrayInfo
from devices.scene.emulated import Family
from devices.scene.file import Scene
from service.estimation.asked import Asking
from service.estimation.calibration import Calibration
from service.estimation.ladder.plan import EstimationPlan
from service.estimation.tare.tare import Tare
from service.offline.calibrations import BENCH, find_calibration
from service.offline.findings import Findings, FindingsOf
from service.offline.stretch import Stretch, since, stretch_of
from service.sessions.pipeline import EstimateOptions, EstimateStream, notes_of
from service.sessions.stances import StancesBeside
from storage.file_hash import sha256_of
from storage.formats.slice import Slice
from storage.schema import MILL, PARTS, TRUTH
from storage.sessions.file import SessionWriter
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.frame_order import in_order
from storage.sessions.reader import SessionReader

_ALL = Slice()
_OF_THE_WHOLE = frozenset({"session", "ledger"})
"""Notes of a session that its part cannot keep: it has other frames."""


@dataclass(frozen=True)
class Estimated:
    """What came of it."""

    frames: int
    plan: EstimationPlan
    findings: Findings
    asked: Mapping[str, float]
    """Models that it asks for and that were not named, with the newtons expected of each."""


def estimate_session(
    source: Path,
    out: Path,
    *,
    calibration: str | Calibration | None,
    models: tuple[str, ...] | None,
    lag_ms: float,
    scene: Scene | None,
    tare_s: tuple[float, float] | None,
    part: Slice = _ALL,
    exact: bool = False,
    remark: Callable[[str], None],
) -> Estimated:
    """Estimate a session; see `foottile estimate --help` for what is taken from where.

    Args:
        source: the session.
        out: the session to write; may be the same file if all of it is estimated.
        calibration: one, or its file, preset or id; None: the session's own.
        models: None: the scene's.
        lag_ms: look-ahead.
        scene: whose models, calibration and places are used; None: the session's.
        tare_s: unloaded interval, in seconds from the first frame of the session.
        part: seconds that are estimated; no more is read of the file than they need.
        exact: nothing is rounded.
        remark: told what is worth knowing.

    Raises:
        FootTileError: the session, scene, calibration or tare is not usable, or no frame is in
            the part; `out` is untouched.
    """
    if not part.is_all and out.exists() and out.samefile(source):
        raise UsageError(
            f"--out {str(out)!r} is the session itself, of which a part would be left",
            expected="another file",
        )
    with SessionReader(source, only_slices=not part.is_all) as session:
        info = _placed(session.info, scene)
        options = EstimateOptions(
            calibration=_calibration(session, scene, calibration, remark),
            models=models or (scene.models if scene else info.models),
            lag_ms=lag_ms,
            tare_s=tare_s,
            tares=_recorded_tares(session) if tare_s is None else (),
            exact=exact,
        )
        kept = [c.name for c in (*PARTS, *TRUTH, *MILL) if session.has(c.name)]
        notes, stretch = session.notes, Stretch()
        if not part.is_all:
            options, stretch = _of_part(session, info, options, part)
            notes = _notes_of_part(session, part, stretch)
        stream = EstimateStream(info, options)
        found = FindingsOf(judging=all(c.name in kept for c in TRUTH))
        asking = Asking(info, options.calibration, options.models)
        stances = StancesBeside()
        frames = 0
        with SessionWriter(out, info, notes) as writer:
            pieces = session.batches(*kept, groups=stretch.groups)
            ordered = in_order(pieces, where=str(source))
            for batch, extra in stretch.given(stream.run(stretch.needed(ordered))):
                if not frames and stream.plan is not None:
                    writer.add_notes(notes_of(stream.plan, stream.rounding, options.tares))
                writer.append(batch, extra)
                frames += len(batch)
                found.feed(batch, extra)
                stances.feed(batch.seq, batch.t_ns, extra)
                if stream.tare is not None:
                    asking.feed(stream.tare, batch, extra["contact"] == 1)
            if not frames or stream.plan is None:
                what = "the session has no frames" + ("" if part.is_all else " in that time")
                raise FileFormatError(what, where=str(source))
    if out.name == FRAMES_NAME:  # in a session's folder
        stances.write(out.parent, sha256_of(out))
        if stances.problem is not None:
            remark(stances.problem)
    return Estimated(frames, stream.plan, found.finish(stream.plan), asking.finish())


def _of_part(
    session: SessionReader, info: ArrayInfo, options: EstimateOptions, part: Slice
) -> tuple[EstimateOptions, Stretch]:
    """Options with the tares in force in a part, as in the whole session, and what is read."""
    stream, tares = EstimateStream(info, options), options.tares
    if not tares:
        ordered = in_order(session.batches(), where=str(session.path))
        tares = (stream.find_tare(ordered),)
    stretch = stretch_of(session, part, stream.plan_of(tares[0]))
    return replace(options, tare_s=None, tares=since(tares, stretch.from_ns)), stretch


def _notes_of_part(session: SessionReader, part: Slice, stretch: Stretch) -> dict[str, object]:
    """The session's, without what is true only of all of it."""
    notes = {name: said for name, said in session.notes.items() if name not in _OF_THE_WHOLE}
    seconds = {"start_s": part.start_s, "end_s": part.end_s, "warm_up_s": stretch.warm_up_s}
    return {**notes, "part_of": {**session.identity, **seconds}}


def _recorded_tares(session: SessionReader) -> tuple[Tare, ...]:
    """Tares that were taken while the session was recorded, oldest first."""
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


def _placed(info: ArrayInfo, scene: Scene | None) -> ArrayInfo:
    """The array with its tiles where the scene says they are."""
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


def _calibration(
    session: SessionReader,
    scene: Scene | None,
    wanted: str | Calibration | None,
    remark: Callable[[str], None],
) -> Calibration:
    notes = session.notes
    where = str(session.path)
    serials = [tile.serial for tile in session.info.tiles if not tile.reference]
    if isinstance(wanted, Calibration):
        for serial in serials:
            wanted.of(serial)
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
    if name == BENCH and "parts_seed" not in notes:
        # The emulated bench would press an emulated tile of the same serial: plausible and wrong.
        raise CalibrationError(
            "the emulated bench knows emulated tiles only, and this session is of real ones",
            where=where,
            remedy="Press the tiles on a real bench and run `foottile calibrate`",
        )
    return find_calibration(
        name,
        serials,
        parts_seed=int(notes.get("parts_seed", 0)),
        family=_family(notes),
        progress=remark,
    )


def _family(notes: Mapping[str, Any]) -> Family:
    """Of the emulated parts of a session; those of before there was another are the usual ones."""
    scene = notes.get("scene")
    emulation = scene.get("emulation") if isinstance(scene, dict) else None
    named = emulation.get("family") if isinstance(emulation, dict) else None
    families: tuple[Family, ...] = get_args(Family)
    return next((family for family in families if family == named), "default")
