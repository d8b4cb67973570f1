"""Lookup of a calibration by name: a preset, a file, or the emulated rig.

The emulated rig indents each tile alone, as a user would, and fits the recording. The result is
deterministic by serial, parts seed and version, and is stored under these in the user's cache. The
program contains those for the tiles of built-in scenes, in `SHIPPED`, so that a first start
need not wait for the rig.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from devices.errors import (
    CalibrationError,
    DamagedFileError,
    StorageError,
    UsageError,
    needs_extra,
)
from devices.scene.emulated import Family
from devices.scene.file import Scene, build_scene, load_scene
from service.estimation.calibration import PRESETS, UNPROVEN, Calibration
from service.estimation.effects import Parameter
from service.rig.emulated import EmulatedFoot
from service.sessions.calibration_file import calibration_of, not_one, write_calibration
from service.user_folders import user_folder
from service.version import SOFTWARE
from storage.durable import make_folder, read_whole, set_aside

EMULATED_RIG = "emulated-rig"
SHIPPED = Path(__file__).parent / "shipped"
"""Made by `FOOTTILE_WRITE_RIG=1 sh scripts/test tests/service/offline/test_shipped.py`."""
RIG_REFERENCE = "emulated mill, 12 bit over 100 N"
RIG_DELAY = Parameter(value=0.0, sigma=0.0001)
"""Delay of the rig's force sensor: no filter, and its converter is read within the frame."""

Progress = Callable[[str], None]


def find_calibration(
    name: str,
    serials: Sequence[str],
    *,
    parts_seed: int = 0,
    family: Family = "default",
    repeatability: float | None = None,
    cache: Path | None = None,
    progress: Progress = lambda message: None,
) -> Calibration:
    """Find a calibration by name, and check that it covers `serials`.

    Args:
        name: "emulated-rig", a preset's name, or the path of a file.
        serials: tiles that it must cover.
        parts_seed: seed of the parts on the emulated rig.
        family: family of these parts.
        repeatability: standard deviation between their loadings; None: that of the rig's scene.
        cache: folder of the rig's results; None: the user's cache.
        progress: called before slow steps.

    Raises:
        CalibrationError: no such calibration, or a tile is missing in it.
    """
    if name == EMULATED_RIG:
        folder = cache if cache is not None else _cache_folder()
        scenes = [bench_scene(serial, family, repeatability) for serial in serials]
        entries = [_bench_tile(scene, parts_seed, folder, progress) for scene in scenes]
        return Calibration(
            name=EMULATED_RIG,
            reference=RIG_REFERENCE,
            date=entries[0].date,
            tiles=tuple(tile for entry in entries for tile in entry.tiles),
        )
    calibration = PRESETS[name]() if name in PRESETS else read_calibration(Path(name))
    for serial in serials:
        calibration.of(serial)
    return calibration


def _cache_folder() -> Path | None:
    """Return the rig's folder in the user's cache; None without a home folder."""
    with suppress(UsageError):
        return user_folder("cache", None, "") / "rig"
    return None


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file; one without hashes, as written by hand, is named as unproven.

    Raises:
        CalibrationError: the file is missing or invalid, or a hash differs.
        StorageError: it cannot be read now.
    """
    try:
        content = read_whole(path.resolve())  # a user may keep links to it
    except FileNotFoundError as error:
        raise CalibrationError(
            f"no calibration {str(path)!r}",
            expected=f"a file, {EMULATED_RIG!r}, or a preset: {', '.join(PRESETS)}",
        ) from error
    except (DamagedFileError, RuntimeError) as error:  # RuntimeError: a loop of links
        what = error.what if isinstance(error, DamagedFileError) else str(error)
        raise not_one(what, str(path)) from error
    return calibration_of(content, where=str(path))


def _bench_tile(
    scene: Scene, parts_seed: int, folder: Path | None, progress: Progress
) -> Calibration:
    serial = scene.tile[0].serial
    # The name contains version and rig scene, because the result depends on both.
    made_by = hashlib.sha256(f"{SOFTWARE}/{parts_seed}/{scene.model_dump_json()}".encode())
    name = f"{serial}-{made_by.hexdigest()[:16]}.json"
    kept = folder / name if folder is not None else None
    if kept is not None and (found := _kept_in(kept, serial, progress)) is not None:
        return found
    if (SHIPPED / name).is_file():
        return read_calibration(SHIPPED / name)
    # Imported here: only the emulated rig needs the physics.
    with needs_extra("server", "the emulated rig"):
        from service.offline.calibrate import calibrate_recordings, read_recordings
        from service.offline.simulate import SimulateOptions, simulate

    progress(f"calibrating tile {serial} on the emulated rig")
    foot = EmulatedFoot(parts_seed=parts_seed)
    with tempfile.TemporaryDirectory(prefix="foottile-bench-") as work:
        recording = Path(work) / f"bench-{serial}.parquet"
        simulate(SimulateOptions(scene, foot=foot), recording, None)
        calibration = calibrate_recordings(
            read_recordings([recording]),
            name=f"{EMULATED_RIG}-{serial}",
            reference=RIG_REFERENCE,
            delay=RIG_DELAY,
        )
    if kept is None:
        progress(
            f"the calibration of {serial} is not cached: the home folder is not writable. Name a "
            "folder in XDG_CACHE_HOME"
        )
        return calibration
    try:
        make_folder(kept.parent)
        write_calibration(kept, calibration)
    except OSError as error:  # the calibration is usable without a cache
        progress(f"the calibration of {serial} is not cached: {error}")
    return calibration


def _kept_in(kept: Path, serial: str, progress: Progress) -> Calibration | None:
    """Return a cached calibration; None if missing or damaged, with a progress message."""
    if not os.path.lexists(kept):
        return None
    try:
        calibration = read_calibration(kept)
        calibration.of(serial)
        what = "it states no hash" if calibration.name.endswith(UNPROVEN) else ""
    except StorageError as error:
        progress(f"{kept} is left out: {error.what}")
        return None
    except CalibrationError as error:
        what = error.what
    if not what:
        return calibration
    try:
        progress(f"{kept} is left out ({what}), and set aside as {set_aside(kept).name}")
    except StorageError as error:
        progress(f"{kept} is left out ({what}): {error}")
    return None


def bench_scene(
    serial: str, family: Family = "default", repeatability: float | None = None
) -> Scene:
    """Build the indenter scene with one tile."""
    scene = with_tiles(load_scene("indentation"), [serial])
    asked: dict[str, object] = {"family": family}
    if repeatability is not None:
        asked["repeatability"] = repeatability
    return scene.model_copy(update={"emulation": scene.emulation.model_copy(update=asked)})


def with_tiles(scene: Scene, serials: Sequence[str]) -> Scene:
    """Return the scene with other tiles, at consecutive channels and positions."""
    tiles = [
        {
            "serial": serial,
            "mux": 0x70 + i // 8,
            "channel": i % 8,
            "x_m": 0.014 * i,
            "y_m": 0.0,
            "z_m": -0.15,
        }
        for i, serial in enumerate(serials)
    ]
    return build_scene({**scene.model_dump(), "tile": tiles}, where=f"scene {scene.name}")
