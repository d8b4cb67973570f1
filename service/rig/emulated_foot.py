"""Options of an emulated foot: load, seeds of parts and noise, plates under it.

A plate depends on the ground only, not on the foot's tiles; a comparison reads only its file. The
injected errors are in a sidecar, `NAME.injected.json`, to judge a comparison; no comparison may
read it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devices.clock import Clock
from devices.emulation.ground.grounds import convert_load_for_scene
from devices.emulation.ground.load_trace import CopTransform, LoadTrace, TileLoad
from devices.errors import require_extra
from devices.scene.hardware_sections import EMULATED
from devices.scene.scene_file import Scene
from storage.durable_files import write_atomically

if TYPE_CHECKING:
    from devices.emulation.plates import PlateClock
    from devices.emulation.world import World

RECORDED_MAX_S = 120.0
"""Longest trial of an instrument, which stops by itself."""
INJECTED_SUFFIX = ".injected.json"


@dataclass(frozen=True)
class PlateFiles:
    """Files of the plates under an emulated foot; None: no such plate."""

    force_plate: Path | None = None
    pressure_plate: Path | None = None

    @property
    def paths_by_instrument(self) -> Mapping[str, Path]:
        """Files of the present plates, by instrument."""
        both = {"force plate": self.force_plate, "pressure plate": self.pressure_plate}
        return {name: path for name, path in both.items() if path is not None}


def write_plate_files(
    files: PlateFiles, world: World, end_ns: int, *, seed: int, parts_seed: int
) -> None:
    """Write the recordings of the plates since the begin of a world's scene, with sidecars.

    Args:
        files: paths to write.
        world: world with the foot.
        end_ns: end of the recording on the node's clock.
        seed: seed for the set-up of the trial, and noise.
        parts_seed: seed for the properties of the plates.

    Raises:
        StorageError: a file cannot be written.
    """
    end_s = min(float(world.to_scene_s(np.array([end_ns]))[0]), RECORDED_MAX_S)
    for instrument, path in files.paths_by_instrument.items():
        record = _record_force_plate if instrument == "force plate" else _record_pressure_plate
        content, injected = record(world, end_s, f"{world.scene.name}/{seed}", parts_seed)
        write_atomically(path, content)
        text = json.dumps({"instrument": instrument, **injected}, indent=1)
        write_atomically(make_injected_path(path), text.encode())


def make_injected_path(path: Path) -> Path:
    """Return the path of the sidecar with the injected errors of a plate's file."""
    return path.with_name(path.stem + INJECTED_SUFFIX)


def _record_force_plate(
    world: World, end_s: float, trial: str, plate: int
) -> tuple[bytes, dict[str, object]]:
    # Imported here for a faster start without plates.
    import pyarrow as pa
    import pyarrow.csv

    with require_extra("emulation", "an emulated plate"):
        from devices.emulation.parts import make_rng
        from devices.emulation.plates import CHANNELS, VERTICAL, ForcePlate

    one = ForcePlate.draw(make_rng(f"force plate/{plate}"), make_rng(f"force plate on {trial}"))
    time_s, channels = one.simulate_recording(
        world.plate_load.compute_wrench, end_s, make_rng(f"force plate noise/{trial}")
    )
    columns = {"time_s": time_s, **dict(zip(CHANNELS, channels.T, strict=True))}
    # The converter's resolution, and microseconds of the clock.
    table = pa.table({name: np.round(values, 6) for name, values in columns.items()})
    text = BytesIO()
    options = pyarrow.csv.WriteOptions(quoting_style="none")
    pyarrow.csv.write_csv(table, text, options)
    return text.getvalue(), {
        **_make_clock_facts(world, one.clock),
        "delay_s": one.delay_s,
        "gain": float(one.sensitivity[VERTICAL, VERTICAL]),
        "offset_n": float(one.offset[VERTICAL]),
        "offset_creep_n_per_s": float(one.creep_per_s[VERTICAL]),
    }


def _record_pressure_plate(
    world: World, end_s: float, trial: str, plate: int
) -> tuple[bytes, dict[str, object]]:
    with require_extra("emulation", "an emulated plate"):
        from devices.emulation.parts import make_rng
        from devices.emulation.plates import PITCH_M, PressurePlate

    foot = world.plate_load
    one = PressurePlate.draw(
        foot.dome_places_m,
        make_rng(f"pressure plate/{plate}"),
        make_rng(f"pressure plate under {trial}"),
    )
    time_s, force_n = one.simulate_recording(foot, end_s, make_rng(f"pressure plate noise/{trial}"))
    arrays = BytesIO()
    np.savez_compressed(
        arrays,
        time_s=time_s,
        force_n=force_n.astype(np.float32),
        pitch_m=np.full(2, PITCH_M),
        origin_m=one.origin_m,
    )
    return arrays.getvalue(), {
        **_make_clock_facts(world, one.clock),
        "delay_s": 0.0,
        "gain": float(one.gains.mean()),
        "offset_n": 0.0,
        "offset_creep_n_per_s": 0.0,
        "placed_m": one.placed_m.tolist(),
        "turned_rad": one.turned_rad,
    }


def _make_clock_facts(world: World, clock: PlateClock) -> dict[str, object]:
    return {
        "zero_t_mono_ns": world.epoch_ns + round(clock.start_s * 1e9),
        "drift_ppm": clock.drift_ppm,
    }


@dataclass(frozen=True)
class EmulatedFoot:
    """Options of an emulation beside the scene; see `foottile simulate --help`."""

    load: LoadTrace | None = None
    load_scale: float = 1.0
    cop_transform: CopTransform = CopTransform()  # noqa: RUF009  # frozen, so one for all is safe
    lead_s: float = 1.0
    seed: int = 0
    parts_seed: int = 0
    plates: PlateFiles = PlateFiles()  # frozen, so one for all is safe

    def compute_tile_load(self, scene: Scene) -> TileLoad | None:
        """Compute the recorded load's forces on the tiles of a scene; None without a load.

        Raises:
            LoadTraceError: the load does not fit the tiles.
        """
        if self.load is None:
            return None
        return convert_load_for_scene(
            scene,
            self.load,
            load_scale=self.load_scale,
            cop_transform=self.cop_transform,
            lead_s=self.lead_s,
        )

    def make_world(
        self,
        scene: Scene,
        clock: Clock,
        tile_load: TileLoad | None,
        *,
        is_repeated: bool = False,
        in_real_time: bool = False,
    ) -> World:
        """Create the emulated world of a scene, before its time begins.

        Raises:
            MissingExtraError: the physics needs packages that are not installed.
        """
        # Imported here, because a real node has no numba.
        with require_extra("emulation", "an emulated array"):
            from devices.emulation.world import World

        return World(
            scene,
            clock,
            seed=self.seed,
            parts_seed=self.parts_seed,
            lead_s=self.lead_s,
            tile_load=tile_load,
            is_repeated=is_repeated,
            begins_now=False,
            in_real_time=in_real_time,
        )

    def write_plate_recordings(self, world: World, end_ns: int) -> None:
        """Write the recordings of the plates under the foot, until an instant of the node's clock.

        Raises:
            StorageError: a file cannot be written.
        """
        write_plate_files(self.plates, world, end_ns, seed=self.seed, parts_seed=self.parts_seed)


@dataclass(frozen=True)
class RigOptions:
    """Options of a rig; `foot` is for emulation only."""

    scene: Scene
    node_name: str
    foot: EmulatedFoot = EmulatedFoot()  # frozen, so one for all is safe
    journals_folder: Path | None = None
    """Folder of the node's journals, for the files of frames in flight in a subfolder per stream.
    """

    @property
    def is_emulated(self) -> bool:
        """True if the tiles are emulated."""
        return self.scene.array.bus == EMULATED
