"""How near a driver on an emulated foot comes to the limit of the bus in real time, and its cost.

    python benchmarks/pace.py [SECONDS] [--wall]

The machine's clock is here the CPU time of this thread, and a wait is a leap: what an idle core
would do, however busy the machine is. `--wall` takes the real clock instead, as a node does. The
limit is the time that a frame's transfers take on the wire, with conversions as the driver measured
them. CPU is split by who used it: the driver, what plays its wires and chips, and the physics of
the domes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

from acquisition import scene_of

from devices.acquisition import Acquisition
from devices.array.schedules import compute_frame_s
from devices.array.startup import prepare_array
from devices.arrays import Floats
from devices.buses.i2c import i2c_msg, open_bus
from devices.clock import Clock, DriverClock, SpinningClock, SystemClock, UtcAnchor, WireClock
from devices.emulation.world import World
from devices.realtime import set_timer_slack
from devices.scene.scene_file import Scene, load_scene

SCENES: dict[str, Callable[[], Scene]] = {
    "standing, 4 tiles": lambda: load_scene("standing"),
    "rolling, 4 tiles": lambda: load_scene("rolling"),
    "8 tiles of 1.6 ms": lambda: scene_of(8, 400_000.0, 1.6),
    "grid, 64 tiles": lambda: load_scene("grid"),
}
_LOOKS = 20_000


class IdleCore:
    """A machine that does nothing else: its time is the CPU time of this thread."""

    def __init__(self) -> None:
        self._slept_ns = 0
        # To ask for CPU time is a call of the kernel; the clock that it stands for is not.
        self._dear_ns = _cost_ns(time.thread_time_ns) - _cost_ns(time.monotonic_ns)

    def now_ns(self) -> int:
        """Nanoseconds that such a machine's clock would have counted."""
        self._slept_ns -= self._dear_ns
        return time.thread_time_ns() + self._slept_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Leap to `t_ns`, if it lies ahead."""
        self._slept_ns += max(0, t_ns - self.now_ns())


def _cost_ns(call: Callable[[], int]) -> int:
    begin_ns = time.thread_time_ns()
    for _ in range(_LOOKS):
        call()
    return (time.thread_time_ns() - begin_ns) // _LOOKS


class Shares:
    """CPU time of this thread by who used it, of one world."""

    def __init__(self, world: World) -> None:
        self.wires_s = self.physics_s = 0.0
        domes = world._domes  # noqa: SLF001  # to measure it
        rdwr, compute = world.i2c_adapter.i2c_rdwr, domes._compute_chunk  # noqa: SLF001  # likewise

        def timed_rdwr(*messages: i2c_msg) -> None:
            begin_s, physics_s = time.thread_time(), self.physics_s
            rdwr(*messages)
            self.wires_s += time.thread_time() - begin_s - (self.physics_s - physics_s)

        def timed_compute(points: int, stride: int) -> Floats:
            begin_s = time.thread_time()
            kpa = compute(points, stride)
            self.physics_s += time.thread_time() - begin_s
            return kpa

        vars(world.i2c_adapter)["i2c_rdwr"] = timed_rdwr
        vars(domes)["_compute_chunk"] = timed_compute


@dataclass(frozen=True)
class Pace:
    """One scene: rates, and CPU time of a frame in us."""

    schedule: str
    rate_hz: float
    bound_hz: float
    missed: int
    driver_us: float
    wires_us: float
    physics_us: float


def measure(scene: Scene, seconds: float, *, wall: bool) -> Pace:
    """Rates and CPU of one scene: two runs, since to look at shares costs time."""
    rates, cpu_us, _ = run(scene, seconds, wall=wall, looks=False)
    _, shared_us, (wires_us, physics_us) = run(scene, seconds, wall=wall, looks=True)
    scale = cpu_us / shared_us
    driver_us = cpu_us - scale * (wires_us + physics_us)
    return Pace(*rates, driver_us, scale * wires_us, scale * physics_us)


def run(
    scene: Scene, seconds: float, *, wall: bool, looks: bool
) -> tuple[tuple[str, float, float, int], float, tuple[float, float]]:
    """Schedule, rate, limit and slots missed; CPU of a frame in us, and if looked at its shares."""
    host: Clock = SpinningClock() if wall else IdleCore()
    clock = DriverClock(host)
    world = World(
        scene,
        WireClock(clock, SystemClock() if wall else host),
        in_real_time=True,
        is_repeated=True,
    )
    shares = Shares(world) if looks else None
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)
    anchor = UtcAnchor.from_readings(0, 0, clock_set=False)
    acquisition = Acquisition(
        ready.array, ready.tiles, clock, anchor, expected_rate_hz=ready.predicted_rate_hz
    )
    if shares is not None:
        shares.wires_s = shares.physics_s = 0.0
    begin_ns, begin_s, frames = clock.now_ns(), time.thread_time(), 0
    for batch in acquisition.acquire_batches(lambda: clock.now_ns() - begin_ns > seconds * 1e9):
        frames += len(batch)
    cpu_us = 1e6 * (time.thread_time() - begin_s) / frames
    rate_hz = 1e9 * frames / (clock.now_ns() - begin_ns)
    schedule = ready.choice.schedule
    rates = (
        schedule,
        rate_hz,
        1.0 / compute_frame_s(schedule, ready.timing),
        acquisition.missed_slots,
    )
    parts = (shares.wires_s, shares.physics_s) if shares is not None else (0.0, 0.0)
    return rates, cpu_us, (1e6 * parts[0] / frames, 1e6 * parts[1] / frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("seconds", type=float, nargs="?", default=4.0)
    parser.add_argument("--wall", action="store_true", help="on the real clock")
    a = parser.parse_args()
    set_timer_slack()
    head = (
        "scene | schedule | frames/s | limit | ratio | missed | driver us | wires us | physics us"
    )
    print(f"| {head} |\n|---|---|--:|--:|--:|--:|--:|--:|--:|")
    for name, scene_of_name in SCENES.items():
        p = measure(scene_of_name(), a.seconds, wall=a.wall)
        print(
            f"| {name} | {p.schedule} | {p.rate_hz:.1f} | {p.bound_hz:.1f} | "
            f"{100 * p.rate_hz / p.bound_hz:.1f} % | {p.missed} | {p.driver_us:.0f} | "
            f"{p.wires_us:.0f} | {p.physics_us:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
