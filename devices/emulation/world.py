"""A whole emulated foot: chips behind multiplexers under domes on a ground, and its ground truth.

A driver gets the world's adapter through `devices.i2c.open_bus` and the pseudo-terminal of its
servo, and nothing else. Truth is for whoever runs the scene, to judge an estimate by.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.clock import Clock
from devices.emulation.dome import Domes, Surroundings
from devices.emulation.dynamixel import EmulatedServo
from devices.emulation.faults import Fault, scene_fault
from devices.emulation.front_end import front_ends
from devices.emulation.ground import Rolling, make_ground, tile_positions_m
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.emulation.load_trace import Floats, PressedTrace
from devices.emulation.mill import Indentation, Mill
from devices.emulation.mpl115a2 import EmulatedMpl115a2
from devices.emulation.parts import draw_chip, draw_dome, random_of
from devices.emulation.tca9548a import EmulatedTca9548a
from devices.scene import FaultKind, Scene, ServoScene

_COUNTS_PER_TURN = 4096
_FORESIGHT_S = 0.4


@dataclass(frozen=True)
class Truth:
    """What was really there at n instants, in the foot frame.

    Attributes:
        true_force_n: (n, tiles), force on each dome along its axis.
        true_grf_n: (n,), their vertical sum: what the array could know.
        true_plate_n: (n,), vertical force on the whole foot.
        true_cop_x_m: (n,), force-weighted place of the load; NaN without load.
        true_cop_y_m: (n,), likewise.
        true_angle_rad: (n,), segment angle; NaN for a foot without one.
    """

    true_force_n: Floats
    true_grf_n: Floats
    true_plate_n: Floats
    true_cop_x_m: Floats
    true_cop_y_m: Floats
    true_angle_rad: Floats


class World:
    """One scene, switched on at the clock's present time.

    Args:
        scene: the scene file.
        clock: virtual or real; bus and servo take their time from it.
        seed: draws noise, outliers, ground and servo noise; not the parts.
        parts_seed: draws other parts for the same serials.
        lead_s: seconds without load before the ground begins.
        pressed: a recorded load instead of the scene's ground.
        looped: press it over and over again.
    """

    def __init__(
        self,
        scene: Scene,
        clock: Clock,
        *,
        seed: int = 0,
        parts_seed: int = 0,
        lead_s: float = 1.0,
        pressed: PressedTrace | None = None,
        looped: bool = False,
    ) -> None:
        self.scene = scene
        self._clock = clock
        self.epoch_ns = clock.now_ns()
        self.ground = make_ground(scene, seed=seed, lead_s=lead_s, pressed=pressed, looped=looped)
        self._positions_m = tile_positions_m(scene.tile)
        serials = [tile.serial for tile in scene.tile]
        chips = [draw_chip(serial, parts_seed) for serial in serials]
        parts = [draw_dome(serial, parts_seed) for serial in serials]
        surroundings = self._surroundings()
        # By scene too: a tile on the bench and in the field must not see the same noise again.
        draw = f"{scene.name}/{seed}"
        domes = self._domes = Domes(
            parts, serials, self.ground, scene.emulation, surroundings, draw
        )
        senses = front_ends(
            chips, parts, serials, domes, surroundings, scene.emulation, self.epoch_ns, draw
        )
        fixed_ms = scene.array.conversion_ms
        self._faults: dict[tuple[FaultKind, str], Fault] = {}
        emulated = []
        for chip, sense, serial in zip(chips, senses, serials, strict=True):
            part = EmulatedMpl115a2(
                chip.coefficients.to_words(),
                chip.conversion_ns if fixed_ms is None else round(fixed_ms * 1e6),
                sense,
                scene.emulation.read_during_conversion,
            )
            part.silent = self._fault("no_answer", serial)
            part.frozen = self._fault("stale", serial)
            emulated.append(part)
        muxes = [
            EmulatedTca9548a(
                address,
                {
                    tile.channel: part
                    for tile, part in zip(scene.tile, emulated, strict=True)
                    if tile.mux == address
                },
            )
            for address in sorted({tile.mux for tile in scene.tile})
        ]
        self.i2c_adapter = EmulatedI2cAdapter(muxes, clock, scene.array.scl_hz)
        self._mill_rng = random_of(f"mill/{draw}")

    def fault(self, kind: FaultKind, serial: str) -> AbstractContextManager[None]:
        """Inject a fault into one part while the block runs."""
        return self._faults[kind, serial].injected()

    @contextmanager
    def servo(self, servo: ServoScene, clock: Clock) -> Iterator[EmulatedServo]:
        """The scene's servo on a pseudo-terminal, with a clock of its own line."""
        with EmulatedServo(
            lambda t_ns: self._servo_counts(servo, t_ns),
            clock,
            servo_id=servo.id,
            model=servo.model,
            protocol=servo.protocol,
            baudrate=servo.baudrate,
        ) as emulated:
            yield emulated

    @contextmanager
    def foresight(self) -> Iterator[None]:
        """For a real clock: compute the physics ahead in a thread while the block runs.

        Without it the bus would now and then wait for it, which no silicon does.
        """
        stop = threading.Event()

        def look_ahead() -> None:
            while not stop.wait(_FORESIGHT_S / 4):
                self._domes.foresee((self._clock.now_ns() - self.epoch_ns) * 1e-9 + _FORESIGHT_S)

        thread = threading.Thread(target=look_ahead, name="physics", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def truth(self, t_mono_ns: npt.NDArray[np.int64]) -> Truth:
        """Ground truth at instants of the node's monotonic clock."""
        t_s = self._seconds(t_mono_ns)
        forces_n = self.ground.forces_n(t_s)
        angle = self.ground.angle_rad(t_s)
        angle_rad = np.full(len(t_s), np.nan) if angle is None else angle
        if isinstance(self.ground, Rolling):
            vertical_n = forces_n * np.cos(self.ground.arc_rad - angle_rad[:, None])
        else:
            vertical_n = forces_n
        grf_n = vertical_n.sum(axis=1)
        weight = vertical_n / np.where(grf_n > 0.0, grf_n, np.nan)[:, None]
        return Truth(
            true_force_n=forces_n,
            true_grf_n=grf_n,
            true_plate_n=grf_n,
            true_cop_x_m=(weight * self._positions_m[:, 0]).sum(axis=1),
            true_cop_y_m=(weight * self._positions_m[:, 1]).sum(axis=1),
            true_angle_rad=angle_rad,
        )

    @property
    def mill(self) -> Mill | None:
        """The reference force sensor beside the spindle, if the ground is the mill."""
        if isinstance(self.ground, Indentation):
            return Mill(self.ground, self.epoch_ns, self._mill_rng)
        return None

    def _fault(self, kind: FaultKind, serial: str) -> Fault:
        fault = scene_fault(self.scene.fault, kind, serial, self.epoch_ns)
        self._faults[kind, serial] = fault
        return fault

    def _surroundings(self) -> Surroundings:
        emulation = self.scene.emulation
        if isinstance(self.ground, Indentation):
            emulation = emulation.model_copy(
                update={
                    "temperature_step_k": self.ground.soak_k,
                    "temperature_step_s": self.ground.warm_from_s,
                }
            )
        return Surroundings(emulation)

    def _seconds(self, t_ns: npt.NDArray[np.int64]) -> Floats:
        return np.asarray((t_ns - self.epoch_ns) * 1e-9)

    def _servo_counts(self, servo: ServoScene, t_ns: int) -> int:
        angle = self.ground.angle_rad(self._seconds(np.array([t_ns])))
        angle_rad = 0.0 if angle is None else float(angle[0])
        turns = angle_rad / (2 * math.pi) / (servo.sign * servo.ratio)
        return servo.zero_counts + math.floor(turns * _COUNTS_PER_TURN + 0.5)
