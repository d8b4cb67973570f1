"""How much faster than real time a session runs on emulated hardware.

    .venv/bin/python benchmarks/simulate_speed.py

Virtual seconds per wall second, median of three runs, estimates and the sealed file included, the
bench left out. Beside it the bare bus: the same transfers without domes, frames or file.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from devices.buses.i2c import i2c_msg
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.fault_timing import PartFaults, SceneFaults
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import load_scene
from service.offline.calibration_lookup import find_calibration
from service.offline.simulation import SimulationOptions, run_simulation
from service.sessions.pipeline import EstimateOptions

SECONDS = 30.0
RUNS = 3


def session(scene_name: str, schedule: ScheduleName | None) -> tuple[float, float]:
    """Frames/s in virtual time, and virtual seconds per wall second."""
    scene = load_scene(scene_name)
    calibration = find_calibration("emulated-rig", [tile.serial for tile in scene.tile])
    options = SimulationOptions(scene, seconds=SECONDS, schedule=schedule)
    estimate = EstimateOptions(calibration, scene.models, 100.0)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(RUNS):
            results.append(run_simulation(options, Path(folder) / "s.parquet", lambda: estimate))
    return results[0].rate_hz, statistics.median(r.seconds / r.wall_s for r in results)


def bare_bus() -> float:
    """Virtual seconds per wall second of ten transfers a frame and nothing else."""
    clock = VirtualClock()
    silicon = EmulatedPart((1, 1, 1, 1), 1_600_000, lambda t_ns: (500, 500))
    chips = [EmulatedMpl115a2(silicon, faults=PartFaults(scene=SceneFaults(()))) for _ in range(4)]
    mux = EmulatedTca9548a(0x70, enumerate(chips))
    adapter = EmulatedI2cAdapter([mux], clock, 400_000.0)
    selects = [i2c_msg.write(0x70, [1 << i]) for i in range(4)]
    everyone = i2c_msg.write(0x70, [0x0F])
    convert, point, read = (
        i2c_msg.write(0x60, [0x12, 0]),
        i2c_msg.write(0x60, [0]),
        i2c_msg.read(0x60, 4),
    )
    began = time.perf_counter()
    while clock.now_ns() < SECONDS * 1e9:
        adapter.i2c_rdwr(everyone)
        adapter.i2c_rdwr(convert)
        clock.sleep_until_ns(clock.now_ns() + 1_600_000)
        for select in selects:
            adapter.i2c_rdwr(select)
            adapter.i2c_rdwr(point, read)
    return SECONDS / (time.perf_counter() - began)


def main() -> None:
    """Print the table."""
    print("| scene | schedule | frames/s | times real time |")
    print("|---|---|--:|--:|")
    print(f"| bare emulated bus | as simultaneous | - | {bare_bus():.1f} |")
    schedules: tuple[ScheduleName | None, ...] = ("pipelined", "simultaneous", "sequential")
    for name, schedule in (*(("standing", schedule) for schedule in schedules), ("rolling", None)):
        rate_hz, factor = session(name, schedule)
        print(f"| {name} | {schedule or 'its own'} | {rate_hz:.1f} | {factor:.1f} |")


if __name__ == "__main__":
    main()
