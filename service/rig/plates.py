"""Emulated plates under an emulated foot, which write down what they see as instruments do.

A plate knows the ground and nothing of the foot's tiles; whoever compares knows its file. Beside
that lies what was injected, `NAME.injected.json`, to judge a comparison by, which none may read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import needs_extra
from storage.durable import write_whole

if TYPE_CHECKING:
    from devices.emulation.plates.clock import PlateClock
    from devices.emulation.world import World

RECORDED_MAX_S = 120.0
"""An instrument's trial: it stops by itself then."""
INJECTED = ".injected.json"


@dataclass(frozen=True)
class PlateFiles:
    """Which plates lie under an emulated foot, each with its file; None: it is not there."""

    force_plate: Path | None = None
    pressure_plate: Path | None = None

    @property
    def by_name(self) -> Mapping[str, Path]:
        """Those that are there."""
        both = {"force plate": self.force_plate, "pressure plate": self.pressure_plate}
        return {name: path for name, path in both.items() if path is not None}


def write_plates(
    files: PlateFiles, world: World, end_ns: int, *, seed: int, parts_seed: int
) -> None:
    """Write what plates have seen since a world's scene began.

    Args:
        files: where.
        world: what happened.
        end_ns: until this instant of the node's clock.
        seed: draws how the trial was set up, and noise.
        parts_seed: draws which plates these are.

    Raises:
        StorageError: a file cannot be written.
    """
    end_s = min(float(world.seconds(np.array([end_ns]))[0]), RECORDED_MAX_S)
    for instrument, path in files.by_name.items():
        record = _force_plate if instrument == "force plate" else _pressure_plate
        content, injected = record(world, end_s, f"{world.scene.name}/{seed}", parts_seed)
        write_whole(path, content)
        text = json.dumps({"instrument": instrument, **injected}, indent=1)
        write_whole(injected_beside(path), text.encode())


def injected_beside(path: Path) -> Path:
    """Where it is written what was injected into a plate's file."""
    return path.with_name(path.stem + INJECTED)


def _force_plate(
    world: World, end_s: float, trial: str, plate: int
) -> tuple[bytes, dict[str, object]]:
    # Here, because a foot without plates is there sooner without it.
    import pyarrow as pa
    import pyarrow.csv

    with needs_extra("emulation", "an emulated plate"):
        from devices.emulation.parts import random_of
        from devices.emulation.plates.force_plate import CHANNELS, ForcePlate
        from devices.emulation.plates.underfoot import VERTICAL

    one = ForcePlate.drawn(random_of(f"force plate/{plate}"), random_of(f"force plate on {trial}"))
    time_s, channels = one.record(
        world.underfoot.wrench, end_s, random_of(f"force plate noise/{trial}")
    )
    columns = {"time_s": time_s, **dict(zip(CHANNELS, channels.T, strict=True))}
    # As many digits as its converter has, and a clock to the microsecond.
    table = pa.table({name: np.round(values, 6) for name, values in columns.items()})
    text = BytesIO()
    options = pyarrow.csv.WriteOptions(quoting_style="none")
    pyarrow.csv.write_csv(table, text, options)
    return text.getvalue(), {
        **_clock(world, one.clock),
        "delay_s": one.delay_s,
        "gain": float(one.mixing[VERTICAL, VERTICAL]),
        "offset_n": float(one.offset[VERTICAL]),
        "offset_creep_n_per_s": float(one.creep_per_s[VERTICAL]),
    }


def _pressure_plate(
    world: World, end_s: float, trial: str, plate: int
) -> tuple[bytes, dict[str, object]]:
    with needs_extra("emulation", "an emulated plate"):
        from devices.emulation.parts import random_of
        from devices.emulation.plates.pressure_plate import PITCH_M, PressurePlate

    foot = world.underfoot
    one = PressurePlate.drawn(
        foot.places_m,
        random_of(f"pressure plate/{plate}"),
        random_of(f"pressure plate under {trial}"),
    )
    time_s, force_n = one.record(foot, end_s, random_of(f"pressure plate noise/{trial}"))
    arrays = BytesIO()
    np.savez_compressed(
        arrays,
        time_s=time_s,
        force_n=force_n.astype(np.float32),
        pitch_m=np.full(2, PITCH_M),
        origin_m=one.origin_m,
    )
    return arrays.getvalue(), {
        **_clock(world, one.clock),
        "delay_s": 0.0,
        "gain": float(one.gains.mean()),
        "offset_n": 0.0,
        "offset_creep_n_per_s": 0.0,
        "placed_m": one.placed_m.tolist(),
        "turned_rad": one.turned_rad,
    }


def _clock(world: World, clock: PlateClock) -> dict[str, object]:
    return {
        "zero_t_mono_ns": world.epoch_ns + round(clock.start_s * 1e9),
        "drift_ppm": clock.drift_ppm,
    }
