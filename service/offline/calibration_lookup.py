"""Lookup of a calibration by name: a preset, a file, or the emulated rig.

The emulated rig indents each tile alone, as a user would, and fits the recording. The result is
deterministic by serial, parts seed and version, and is stored under these in the user's cache. The
program contains those for the tiles of built-in scenes, in `SHIPPED_FOLDER`, so that a first start
need not wait for the rig.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from devices.errors import (
    CalibrationError,
    DamagedFileError,
    FileFormatError,
    MissingExtraError,
    StorageError,
    UsageError,
    require_extra,
)
from devices.scene.emulation_sections import PartFamily
from devices.scene.scene_file import Scene, load_scene, replace_chips, validate_scene
from service.estimation.calibration import PRESETS, UNPROVEN_SUFFIX, Calibration
from service.estimation.effects import Parameter
from service.rig.emulated_foot import EmulatedFoot, RigOptions
from service.sessions.calibration_file import (
    make_not_a_calibration_error,
    parse_calibration,
    write_calibration,
)
from service.user_folders import resolve_user_folder
from service.version import SOFTWARE_VERSION
from storage.durable_files import make_synced_folder, read_small_file, set_aside_damaged
from storage.sessions.reader import SealedFileReader

EMULATED_RIG = "emulated-rig"
SHIPPED_FOLDER = Path(__file__).parent / "shipped"
"""Made by `FOOTTILE_WRITE_RIG=1 sh scripts/test tests/service/offline/test_shipped.py`."""
RIG_REFERENCE = "emulated mill, 12 bit over 100 N"
RIG_REFERENCE_DELAY = Parameter(value=0.0, sigma=0.0001)
"""Delay of the rig's force sensor: no filter, and its converter is read within the frame."""

ProgressCallback = Callable[[str], None]


def find_calibration(
    name: str,
    serials: Sequence[str],
    *,
    chips: Mapping[str, str] = MappingProxyType({}),
    parts_seed: int = 0,
    family: PartFamily = "default",
    repeatability: float | None = None,
    cache_folder: Path | None = None,
    on_progress: ProgressCallback = lambda message: None,
) -> Calibration:
    """Find a calibration by name, and check that it covers `serials`.

    Args:
        name: "emulated-rig", a preset's name, or the path of a file.
        serials: tiles that it must cover.
        chips: kinds of chip on the emulated rig, by serial; default: MPL115A2.
        parts_seed: seed of the parts on the emulated rig.
        family: family of these parts.
        repeatability: standard deviation between their loadings; None: that of the rig's scene.
        cache_folder: folder of the rig's results; None: the user's cache.
        on_progress: called before slow steps.

    Raises:
        CalibrationError: no such calibration, or a tile is missing in it.
    """
    if name == EMULATED_RIG:
        folder = cache_folder if cache_folder is not None else _cache_folder()
        scenes = [
            make_rig_scene(serial, family, repeatability, chip=chips.get(serial))
            for serial in serials
        ]
        entries = [_calibrate_on_rig(scene, parts_seed, folder, on_progress) for scene in scenes]
        return Calibration(
            name=EMULATED_RIG,
            reference=RIG_REFERENCE,
            date=entries[0].date,
            tiles=tuple(tile for entry in entries for tile in entry.tiles),
        )
    calibration = PRESETS[name]() if name in PRESETS else read_calibration(Path(name))
    calibration.get_tiles_or_wildcard(serials)
    return calibration


def read_calibration_of_session(session: SealedFileReader) -> Calibration | None:
    """Return the calibration that a session contains; None without one.

    Raises:
        FileFormatError: it is invalid, or of another version.
    """
    if "calibration" not in session.notes:
        return None
    try:
        return Calibration.model_validate(session.notes["calibration"])
    except ValueError as error:
        raise FileFormatError(
            f"its calibration is not readable: {error}", where=str(session.path)
        ) from error


def _cache_folder() -> Path | None:
    """Return the rig's folder in the user's cache; None without a home folder."""
    with suppress(UsageError):
        return resolve_user_folder("cache", None, "") / "rig"
    return None


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file; one without hashes, as written by hand, is named as unproven.

    Raises:
        CalibrationError: the file is missing or invalid, or a hash differs.
        StorageError: it cannot be read now.
    """
    try:
        content = read_small_file(path.resolve())  # a user may keep links to it
    except FileNotFoundError as error:
        raise CalibrationError(
            f"no calibration {str(path)!r}",
            expected=f"a file, {EMULATED_RIG!r}, or a preset: {', '.join(PRESETS)}",
        ) from error
    except (DamagedFileError, RuntimeError) as error:  # RuntimeError: a loop of links
        what = error.what if isinstance(error, DamagedFileError) else str(error)
        raise make_not_a_calibration_error(what, str(path)) from error
    return parse_calibration(content, where=str(path))


def _calibrate_on_rig(
    scene: Scene, parts_seed: int, folder: Path | None, progress: ProgressCallback
) -> Calibration:
    serial = scene.tile[0].serial
    # The name contains version and rig scene, defaults too, because the result depends on all but
    # the sync lines.
    rig = scene.model_dump_json(exclude={"sync"})
    made_by = hashlib.sha256(f"{SOFTWARE_VERSION}/{parts_seed}/{rig}".encode())
    name = f"{serial}-{made_by.hexdigest()[:16]}.json"
    kept = folder / name if folder is not None else None
    if kept is not None and (found := _read_cached(kept, serial, progress)) is not None:
        return found
    if (SHIPPED_FOLDER / name).is_file():
        return read_calibration(SHIPPED_FOLDER / name)
    # Imported here: only the emulated rig needs the physics.
    with require_extra("server", "the emulated rig"):
        from service.offline.calibration_fit import fit_calibration, read_indentations
        from service.offline.simulation import SimulationOptions, run_simulation

    progress(f"calibrating tile {serial} on the emulated rig")
    foot = EmulatedFoot(parts_seed=parts_seed)
    with tempfile.TemporaryDirectory(prefix="foottile-bench-") as work:
        recording = Path(work) / f"bench-{serial}.parquet"
        run_simulation(SimulationOptions(scene, foot=foot), recording, None)
        calibration = fit_calibration(
            read_indentations([recording]),
            name=f"{EMULATED_RIG}-{serial}",
            reference_name=RIG_REFERENCE,
            reference_delay=RIG_REFERENCE_DELAY,
        )
    if kept is None:
        progress(
            f"the calibration of {serial} is not cached: the home folder is not writable. Name a "
            "folder in XDG_CACHE_HOME"
        )
        return calibration
    try:
        make_synced_folder(kept.parent)
        write_calibration(kept, calibration)
    except OSError as error:  # the calibration is usable without a cache
        progress(f"the calibration of {serial} is not cached: {error}")
    return calibration


def _read_cached(kept: Path, serial: str, progress: ProgressCallback) -> Calibration | None:
    """Return a cached calibration; None if missing or damaged, with a progress message."""
    if not os.path.lexists(kept):
        return None
    try:
        calibration = read_calibration(kept)
        calibration.get_tile_or_wildcard(serial)
        what = "it states no hash" if calibration.name.endswith(UNPROVEN_SUFFIX) else ""
    except StorageError as error:
        progress(f"{kept} is left out: {error.what}")
        return None
    except CalibrationError as error:
        what = error.what
    if not what:
        return calibration
    try:
        progress(f"{kept} is left out ({what}), and set aside as {set_aside_damaged(kept).name}")
    except StorageError as error:
        progress(f"{kept} is left out ({what}): {error}")
    return None


def make_rig_scene(
    serial: str,
    family: PartFamily = "default",
    repeatability: float | None = None,
    *,
    chip: str | None = None,
) -> Scene:
    """Build the indenter scene with one tile; `chip` None: the usual one."""
    scene = replace_tiles(load_scene("indentation"), [serial])
    if chip is not None and chip != scene.tile[0].chip:
        scene = replace_chips(scene, chip)
    requested: dict[str, object] = {"family": family}
    if repeatability is not None:
        requested["repeatability"] = repeatability
    return scene.model_copy(update={"emulation": scene.emulation.model_copy(update=requested)})


def replace_tiles(scene: Scene, serials: Sequence[str]) -> Scene:
    """Return the scene with other tiles, at consecutive channels and positions.

    Their chips are those of its first one.
    """
    kind = scene.tile[0].model_dump(include={"chip", "oversampling", "filter", "mode"})
    tiles = [
        kind
        | {
            "serial": serial,
            "mux": 0x70 + i // 8,
            "channel": i % 8,
            "x_m": 0.014 * i,
            "y_m": 0.0,
            "z_m": -0.15,
        }
        for i, serial in enumerate(serials)
    ]
    return validate_scene({**scene.model_dump(), "tile": tiles}, where=f"scene {scene.name}")


def find_scene_calibration(
    options: RigOptions, on_progress: ProgressCallback
) -> tuple[Calibration | None, str | None]:
    """Return the calibration of a rig's scene, or the reason for its absence.

    `on_progress` also receives the reason, unless the scene names none: raw frames need none.
    """
    scene = options.scene
    if scene.calibration == "none":
        return None, "the scene names no calibration"
    if scene.calibration == EMULATED_RIG and not options.is_emulated:
        # The emulated rig would calibrate an emulated tile of the same serial: plausible and wrong.
        problem = (
            "the emulated rig is for emulated tiles only: load the tiles on a real rig, run "
            "`foottile calibrate`, and name its file in the scene"
        )
        on_progress(f"no calibration, so no forces: {problem}")
        return None, problem
    try:
        calibration = find_calibration(
            scene.calibration,
            [tile.serial for tile in scene.tile if not tile.reference],
            chips={tile.serial: tile.chip for tile in scene.tile},
            parts_seed=options.foot.parts_seed,
            family=scene.emulation.family,
            on_progress=on_progress,
        )
    except (CalibrationError, MissingExtraError) as error:
        on_progress(f"no calibration, so no forces: {error}")
        return None, str(error)
    return calibration, None
