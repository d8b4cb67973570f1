"""Emulated foot: chips behind multiplexers under domes on a ground, with its ground truth.

A driver gets only the world's I2C adapter, through `devices.buses.i2c.open_bus`, and the
pseudo-terminal of the servo. Ground truth is for judging estimates only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol, get_args

import numpy as np

from devices.arrays import Floats, Times
from devices.chips.dynamixel.protocol import COUNTS_PER_TURN
from devices.clock import Clock
from devices.emulation.chips import bmp581, mpl115a2
from devices.emulation.chips.dynamixel import EmulatedServo
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.dome_physics import Domes
from devices.emulation.fault_timing import PartFaults, SceneFaults
from devices.emulation.ground.grounds import get_tile_positions_m, make_ground
from devices.emulation.ground.hopping import Hopping
from devices.emulation.ground.indenter import IndentationProgramme, Indenter
from devices.emulation.ground.load_trace import TileLoad
from devices.emulation.i2c_bus import EmulatedChip, EmulatedI2cAdapter, FaultyWires
from devices.emulation.parts import draw_family_dome, make_rng
from devices.emulation.plates import PlateLoad
from devices.emulation.surroundings import ChipSite, Puncture, Surroundings
from devices.scene.emulation_sections import (
    BUS_TARGET,
    DEFAULT_LEAK_S,
    FaultKind,
    MudGround,
    PartFault,
)
from devices.scene.hardware_sections import ServoSection, TileSection
from devices.scene.scene_file import Scene


class ChipMaker(Protocol):
    """Function that makes the emulated chip of a scene's tile."""

    def __call__(
        self,
        tile: TileSection,
        scene: Scene,
        parts_seed: int,
        faults: PartFaults,
        make_site: Callable[[str], ChipSite],
    ) -> EmulatedChip:
        """Make the chip; `make_site` makes the site of its serial, or of a spare part's."""


CHIP_MAKERS: dict[str, ChipMaker] = {
    "mpl115a2": mpl115a2.make_chip,
    "bmp581": bmp581.make_chip,
}
"""Emulation of every kind of pressure chip."""

DomeEffect = Literal["gas", "rubber", "hysteresis", "surroundings"]
"""Effect on a dome's pressure beside the static curve; surroundings: temperature, head of water."""


@dataclass(frozen=True)
class GroundTruth:
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
        tile_load: recorded load instead of the scene's ground.
        is_repeated: repeat the recorded load or the hops endlessly.
        begins_now: the scene's time begins now; else at `begin`, and until then the scene stays at
            its first instant.
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
        tile_load: TileLoad | None = None,
        is_repeated: bool = False,
        begins_now: bool = True,
        in_real_time: bool = False,
    ) -> None:
        self.scene = scene
        self.clock = clock
        """Clock of the emulated bus."""
        self._has_begun = False
        self.epoch_ns = 0
        """Instant of the clock at which the scene's time began."""
        self.ground = make_ground(
            scene, seed=seed, lead_s=lead_s, tile_load=tile_load, is_repeated=is_repeated
        )
        self._positions_m = get_tile_positions_m(scene.tile)
        self.plate_load = PlateLoad(self.ground, self._positions_m)
        """Load of a plate under the foot."""
        serials = [tile.serial for tile in scene.tile]
        family = scene.emulation.family
        domes = [draw_family_dome(family, serial, parts_seed) for serial in serials]
        # The scene is part of the label: noise must differ between calibration and field.
        draw = f"{scene.name}/{seed}"
        self._scene_surroundings = surroundings = self._make_surroundings(draw)
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
        self.dome_parts = tuple(domes)
        """Properties of the domes, for judging estimates only."""
        self._faults = SceneFaults(scene.fault)
        self._sites: list[ChipSite] = []
        self.chips = [
            CHIP_MAKERS[tile.chip](
                tile,
                scene,
                parts_seed,
                self._collect_part_faults(tile.serial),
                partial(self._make_site, index, draw),
            )
            for index, tile in enumerate(scene.tile)
        ]
        """Chips, for judging drivers only; a driver has only the bus."""
        self.i2c_adapter = EmulatedI2cAdapter(
            self._make_muxes(),
            clock,
            scene.array.scl_hz * scene.emulation.scl_part,
            FaultyWires(self._faults, f"line/{draw}"),
        )
        self._indenter_rng = make_rng(f"mill/{draw}")
        if begins_now:
            self.begin_scene_time()

    def _make_muxes(self) -> list[EmulatedTca9548a]:
        """Make the multiplexers, each with the chips on its channels."""
        return [
            EmulatedTca9548a(
                address,
                [
                    (tile.channel, chip)
                    for tile, chip in zip(self.scene.tile, self.chips, strict=True)
                    if tile.mux == address
                ],
                self._faults.get_fault("brown_out", f"0x{address:02x}"),
                self._faults.get_fault("mux_reset", f"0x{address:02x}"),
            )
            for address in sorted({tile.mux for tile in self.scene.tile})
        ]

    def begin_scene_time(self) -> None:
        """Begin the scene's time now: ground, faults, temperature."""
        self.epoch_ns = self.clock.now_ns()
        self._has_begun = True
        for site in self._sites:
            site.begin_scene_time(self.epoch_ns)
        self._faults.begin_scene_time(self.epoch_ns)

    def inject_fault(
        self, kind: FaultKind, target: str = BUS_TARGET
    ) -> AbstractContextManager[None]:
        """Inject a fault into a tile, a mux ("0x70") or the bus, within a `with` block."""
        return self._faults.inject(kind, target)

    @contextmanager
    def open_servo(self, servo: ServoSection, clock: Clock) -> Iterator[EmulatedServo]:
        """Open the scene's servo on a pseudo-terminal, with the clock of its line."""
        with EmulatedServo(
            lambda t_ns: self._servo_counts(servo, t_ns),
            clock,
            servo_id=servo.id,
            model=servo.model,
            protocol=servo.protocol,
            baudrate=servo.baudrate,
            many_turns=not 0 <= servo.zero_counts < COUNTS_PER_TURN,
            unplugged=self._faults.get_fault("servo_unplugged"),
            unpowered=self._faults.get_fault("servo_restart"),
        ) as emulated:
            yield emulated

    def compute_truth(self, t_mono_ns: Times) -> GroundTruth:
        """Compute the ground truth at instants of the node's monotonic clock."""
        t_s = self.to_scene_s(t_mono_ns)
        forces_n = self.ground.forces_n(t_s)
        angle = self.ground.angle_rad(t_s)
        angle_rad = np.full(len(t_s), np.nan) if angle is None else angle
        vertical_n = forces_n * np.cos(self.ground.tilt_rad(t_s))
        grf_n = vertical_n.sum(axis=1)
        weight = vertical_n / np.where(grf_n > 0.0, grf_n, np.nan)[:, None]
        return GroundTruth(
            true_force_n=forces_n,
            true_grf_n=grf_n,
            true_plate_n=grf_n + self.ground.force_beside_domes_n(t_s),
            true_cop_x_m=(weight * self._positions_m[:, 0]).sum(axis=1),
            true_cop_y_m=(weight * self._positions_m[:, 1]).sum(axis=1),
            true_angle_rad=angle_rad,
        )

    def compute_dome_kpa(
        self, t_mono_ns: Times, without_effects: Collection[DomeEffect] = ()
    ) -> Floats:
        """Compute the true pressure in each dome at rising instants, without some effects.

        Computed anew from the scene's first instant on. Without "gas" it is the static pressure of
        each instant's load.

        Returns:
            (n, tiles); for a bare tile the pressure around it.
        """
        emulation = self.scene.emulation
        off: dict[str, object] = {name: False for name in without_effects if name != "surroundings"}
        if "surroundings" in without_effects:
            off |= {"temperature_step_k": 0.0, "head_kpa": 0.0}
        emulation = emulation.model_copy(update=off)
        around = (
            Surroundings(emulation)
            if "surroundings" in without_effects
            else self._scene_surroundings
        )
        domes = self._domes.with_effects(emulation, around)
        pressed = [
            [domes.compute_pressure_kpa(dome, t_s) for dome in range(len(self.dome_parts))]
            for t_s in self.to_scene_s(t_mono_ns).tolist()
        ]
        return np.array(pressed).reshape(len(t_mono_ns), len(self.dome_parts))

    @property
    def indenter(self) -> Indenter | None:
        """Reference force sensor of the indenter; None on any other ground."""
        if isinstance(self.ground, IndentationProgramme):
            return Indenter(self.ground, self.to_scene_s, self._indenter_rng)
        return None

    def _make_site(self, index: int, draw: str, serial: str) -> ChipSite:
        """Make the site of a tile's chip, or of a part in its place."""
        tile, dome = self.scene.tile[index].serial, self.dome_parts[index]
        surroundings = self._scene_surroundings
        site = ChipSite(
            partial(self._domes.compute_pressure_kpa, index),
            (dome.chip_lag_s, dome.gas_lag_s),
            surroundings,
            self.scene.emulation,
            f"noise/{draw}/{serial}",
            over_range=self._faults.get_fault("over_range", tile),
            frozen=self._faults.get_fault("frozen", tile),
            puncture=self._make_puncture(tile, surroundings),
        )
        if self._has_begun:
            site.begin_scene_time(self.epoch_ns)
        self._sites.append(site)
        return site

    def _make_puncture(self, serial: str, surroundings: Surroundings) -> Puncture:
        leaks_s = (f.leak_s for f in self.scene.fault if (f.kind, f.tile) == ("puncture", serial))
        fault = self._faults.get_fault("puncture", serial)
        return Puncture(fault, next(leaks_s, DEFAULT_LEAK_S), surroundings.ambient_kpa)

    def _collect_part_faults(self, serial: str) -> PartFaults:
        own = {kind: self._faults.get_fault(kind, serial) for kind in get_args(PartFault)}
        return PartFaults(**own, scene=self._faults)

    def _make_surroundings(self, draw: str) -> Surroundings:
        emulation, ground = self.scene.emulation, self.ground
        step_k = step_s = 0.0
        if isinstance(ground, IndentationProgramme):
            step_k, step_s = ground.soak_k, ground.temperature_step_s
        elif isinstance(self.scene.ground, MudGround) and isinstance(ground, Hopping):
            step_k, step_s = self.scene.ground.temperature_step_k, ground.touch_down_s[0]
        if step_k:
            emulation = emulation.model_copy(
                update={"temperature_step_k": step_k, "temperature_step_s": step_s}
            )
        return Surroundings(emulation, ground if isinstance(ground, Hopping) else None, draw)

    def to_scene_s(self, t_ns: Times) -> Floats:
        """Convert instants of the clock to seconds of the scene; zero before its begin."""
        if not self._has_begun:
            return np.zeros(len(t_ns))
        return np.asarray(np.maximum(t_ns - self.epoch_ns, 0) * 1e-9)

    def _servo_counts(self, servo: ServoSection, t_ns: int) -> int:
        angle = self.ground.angle_rad(self.to_scene_s(np.array([t_ns])))
        angle_rad = 0.0 if angle is None else float(angle[0])
        turns = angle_rad / (2 * math.pi) / (servo.sign * servo.ratio)
        return servo.zero_counts + math.floor(turns * COUNTS_PER_TURN + 0.5)
