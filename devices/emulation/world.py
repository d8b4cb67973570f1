"""Emulated foot: chips behind multiplexers under domes on a ground, with its ground truth.

A driver gets only the world's I2C adapter, through `devices.buses.i2c.open_bus`, and the
pseudo-terminal of the servo. Ground truth is for judging estimates only.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np

from devices.arrays import Floats, Times
from devices.chips.dynamixel.models import COUNTS_PER_TURN
from devices.clock import Clock
from devices.emulation.buses.i2c import EmulatedI2cAdapter, Line
from devices.emulation.chips.dynamixel import EmulatedServo
from devices.emulation.chips.front_end import FrontEnd
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, PartFaults, Silicon
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.dome import Domes
from devices.emulation.families import chip_of, dome_of
from devices.emulation.faults import Faults
from devices.emulation.ground.grounds import make_ground, tile_positions_m
from devices.emulation.ground.hopping import Hopping
from devices.emulation.ground.load_trace import PressedTrace
from devices.emulation.ground.mill import Indentation, Mill
from devices.emulation.parts import random_of
from devices.emulation.plates.underfoot import Underfoot
from devices.emulation.puncture import Puncture
from devices.emulation.surroundings import Surroundings
from devices.scene.emulated import BUS, LEAK_S, FaultKind, MudGround, PartFault
from devices.scene.file import Scene
from devices.scene.hardware import ServoScene

Effect = Literal["gas", "rubber", "hysteresis", "surroundings"]
"""Effect on a dome's pressure beside the static curve; surroundings: temperature, head of water."""


@dataclass(frozen=True)
class Truth:
    """Ground truth at n instants, in the foot frame.

    Attributes:
        true_force_n: (n, tiles), force on each dome along its axis.
        true_grf_n: (n,), vertical sum of the dome forces: the ideal measurement of the array.
        true_plate_n: (n,), vertical force on the whole foot: the load of a plate under it.
        true_cop_x_m: (n,), force-weighted position of the load; NaN without load.
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
    """Emulation of one scene, powered up at the clock's present time.

    Args:
        scene: the scene file.
        clock: virtual or real clock of bus and servo.
        seed: seed of noise, outliers, ground and servo noise; not of the parts.
        parts_seed: seed of the parts; other seeds give other parts for the same serials.
        lead_s: seconds without load before the ground begins.
        pressed: recorded load instead of the scene's ground.
        looped: repeat the recorded load or the hops endlessly.
        begun: the scene's time begins now; else at `begin`, and until then the scene stays at its
            first instant.
        in_real_time: the clock runs by itself, see `Domes`.
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
        begun: bool = True,
        in_real_time: bool = False,
    ) -> None:
        self.scene = scene
        self.clock = clock
        """Clock of the emulated bus."""
        self._begun = False
        self.epoch_ns = 0
        """Instant of the clock at which the scene's time began."""
        self.ground = make_ground(scene, seed=seed, lead_s=lead_s, pressed=pressed, looped=looped)
        self._positions_m = tile_positions_m(scene.tile)
        self.underfoot = Underfoot(self.ground, self._positions_m)
        """Load of a plate under the foot."""
        serials = [tile.serial for tile in scene.tile]
        family = scene.emulation.family
        domes = [dome_of(family, serial, parts_seed) for serial in serials]
        # The scene is part of the label: noise must differ between calibration and field.
        draw = f"{scene.name}/{seed}"
        self._around = surroundings = self._surroundings(draw)
        bare = [tile.reference for tile in scene.tile]
        self._domes = Domes(
            domes,
            serials,
            self.ground,
            scene.emulation,
            surroundings,
            label=draw,
            bare=bare,
            in_real_time=in_real_time,
        )
        self.domes = tuple(domes)
        """Properties of the domes, for judging estimates only."""
        self._faults = Faults(scene.fault)
        self._front_ends: list[FrontEnd] = []

        def silicon(index: int, serial: str) -> Silicon:
            """Create the chip of a serial under a dome of this foot."""
            chip = chip_of(family, serial, parts_seed)
            fixed_ms = scene.array.conversion_ms
            sense = FrontEnd(
                chip,
                domes[index],
                partial(self._domes.pressure_kpa, index),
                surroundings,
                scene.emulation,
                f"noise/{draw}/{serial}",
                self._faults.of("over_range", serials[index]),
                self._faults.of("frozen", serials[index]),
                self._puncture(serials[index], surroundings),
            )
            if self._begun:
                sense.begin(self.epoch_ns)
            self._front_ends.append(sense)
            conversion_ns = chip.conversion_ns if fixed_ms is None else round(fixed_ms * 1e6)
            return Silicon(chip.coefficients.to_words(), conversion_ns, sense, chip.late_ns)

        self.parts = [
            EmulatedMpl115a2(
                silicon(index, serial),
                scene.emulation.read_during_conversion,
                self._part_faults(serial),
                spare=partial(silicon, index, f"{serial}.spare"),
            )
            for index, serial in enumerate(serials)
        ]
        """Chips, for judging drivers only; a driver has only the bus."""
        muxes = [
            EmulatedTca9548a(
                address,
                {
                    tile.channel: part
                    for tile, part in zip(scene.tile, self.parts, strict=True)
                    if tile.mux == address
                },
                self._faults.of("brown_out", f"0x{address:02x}"),
                self._faults.of("mux_reset", f"0x{address:02x}"),
            )
            for address in sorted({tile.mux for tile in scene.tile})
        ]
        self.i2c_adapter = EmulatedI2cAdapter(
            muxes,
            clock,
            scene.array.scl_hz * scene.emulation.scl_part,
            Line(self._faults, f"line/{draw}"),
        )
        self._mill_rng = random_of(f"mill/{draw}")
        if begun:
            self.begin()

    def begin(self) -> None:
        """Begin the scene's time now: ground, faults, temperature."""
        self.epoch_ns = self.clock.now_ns()
        self._begun = True
        for front_end in self._front_ends:
            front_end.begin(self.epoch_ns)
        self._faults.begin(self.epoch_ns)

    def fault(self, kind: FaultKind, target: str = BUS) -> AbstractContextManager[None]:
        """Inject a fault into a tile, a mux ("0x70") or the bus, within a `with` block."""
        return self._faults.injected(kind, target)

    @contextmanager
    def servo(self, servo: ServoScene, clock: Clock) -> Iterator[EmulatedServo]:
        """Open the scene's servo on a pseudo-terminal, with the clock of its line."""
        with EmulatedServo(
            lambda t_ns: self._servo_counts(servo, t_ns),
            clock,
            servo_id=servo.id,
            model=servo.model,
            protocol=servo.protocol,
            baudrate=servo.baudrate,
            many_turns=not 0 <= servo.zero_counts < COUNTS_PER_TURN,
            unplugged=self._faults.of("servo_unplugged"),
            unpowered=self._faults.of("servo_restart"),
        ) as emulated:
            yield emulated

    def truth(self, t_mono_ns: Times) -> Truth:
        """Compute the ground truth at instants of the node's monotonic clock."""
        t_s = self.seconds(t_mono_ns)
        forces_n = self.ground.forces_n(t_s)
        angle = self.ground.angle_rad(t_s)
        angle_rad = np.full(len(t_s), np.nan) if angle is None else angle
        vertical_n = forces_n * np.cos(self.ground.tilt_rad(t_s))
        grf_n = vertical_n.sum(axis=1)
        weight = vertical_n / np.where(grf_n > 0.0, grf_n, np.nan)[:, None]
        return Truth(
            true_force_n=forces_n,
            true_grf_n=grf_n,
            true_plate_n=grf_n + self.ground.rest_n(t_s),
            true_cop_x_m=(weight * self._positions_m[:, 0]).sum(axis=1),
            true_cop_y_m=(weight * self._positions_m[:, 1]).sum(axis=1),
            true_angle_rad=angle_rad,
        )

    def dome_kpa(self, t_mono_ns: Times, without: Collection[Effect] = ()) -> Floats:
        """Compute the true pressure in each dome at rising instants, without some effects.

        Computed anew from the scene's first instant on. Without "gas" it is the static pressure of
        each instant's load.

        Returns:
            (n, tiles); for a bare tile the pressure around it.
        """
        emulation = self.scene.emulation
        off: dict[str, object] = {name: False for name in without if name != "surroundings"}
        if "surroundings" in without:
            off |= {"temperature_step_k": 0.0, "head_kpa": 0.0}
        emulation = emulation.model_copy(update=off)
        around = Surroundings(emulation) if "surroundings" in without else self._around
        domes = self._domes.again(emulation, around)
        pressed = [
            [domes.pressure_kpa(dome, t_s) for dome in range(len(self.domes))]
            for t_s in self.seconds(t_mono_ns).tolist()
        ]
        return np.array(pressed).reshape(len(t_mono_ns), len(self.domes))

    @property
    def mill(self) -> Mill | None:
        """Reference force sensor of the indenter; None on any other ground."""
        if isinstance(self.ground, Indentation):
            return Mill(self.ground, self.seconds, self._mill_rng)
        return None

    def _puncture(self, serial: str, surroundings: Surroundings) -> Puncture:
        leaks_s = (f.leak_s for f in self.scene.fault if (f.kind, f.tile) == ("puncture", serial))
        fault = self._faults.of("puncture", serial)
        return Puncture(fault, next(leaks_s, LEAK_S), surroundings.ambient_kpa)

    def _part_faults(self, serial: str) -> PartFaults:
        own = {kind: self._faults.of(kind, serial) for kind in get_args(PartFault)}
        return PartFaults(**own, scene=self._faults)

    def _surroundings(self, draw: str) -> Surroundings:
        emulation, ground = self.scene.emulation, self.ground
        step_k = step_s = 0.0
        if isinstance(ground, Indentation):
            step_k, step_s = ground.soak_k, ground.warm_from_s
        elif isinstance(self.scene.ground, MudGround) and isinstance(ground, Hopping):
            step_k, step_s = self.scene.ground.temperature_step_k, ground.touch_s[0]
        if step_k:
            emulation = emulation.model_copy(
                update={"temperature_step_k": step_k, "temperature_step_s": step_s}
            )
        return Surroundings(emulation, ground if isinstance(ground, Hopping) else None, draw)

    def seconds(self, t_ns: Times) -> Floats:
        """Convert instants of the clock to seconds of the scene; zero before its begin."""
        if not self._begun:
            return np.zeros(len(t_ns))
        return np.asarray(np.maximum(t_ns - self.epoch_ns, 0) * 1e-9)

    def _servo_counts(self, servo: ServoScene, t_ns: int) -> int:
        angle = self.ground.angle_rad(self.seconds(np.array([t_ns])))
        angle_rad = 0.0 if angle is None else float(angle[0])
        turns = angle_rad / (2 * math.pi) / (servo.sign * servo.ratio)
        return servo.zero_counts + math.floor(turns * COUNTS_PER_TURN + 0.5)
