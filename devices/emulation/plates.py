"""Emulated instruments under the foot: force plate and pressure plate, with separate clocks.

Laboratory axes: x forward, y left, z up; forces of the ground on the foot, in newtons; moments
about the middle of the plate's surface. The foot's middle is over it.

The force plate is a mass on a spring with six channels; its amplifier has a low-pass filter.
Channels have crosstalk, gain errors, a drifting offset, noise, and quantization.

The pressure plate is a matrix of cells with individual gains, a threshold and a limit. The domes
touch it. Each makes a round patch with the pressure of an elastic sphere on a plane
(Hertz), whose middle is the dome's place on the plate and whose radius is at most the dome's.
Sources and confidence of the numbers are in hardware.md 11.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.emulation.ground.ground import Ground
from devices.errors import UsageError
from devices.scene.scene_file import Scene

FORCES = (0, 1, 2)
MOMENTS = (3, 4, 5)
VERTICAL = 2

_GROUND_KINDS_BY_INSTRUMENT = {"force plate": {"none", "plate", "rolling", "trace", "poppy", "mud"}}
_GROUND_KINDS_BY_INSTRUMENT["pressure plate"] = _GROUND_KINDS_BY_INSTRUMENT["force plate"] - {
    "poppy",
    "mud",
}
"""Grounds with which an instrument can be used: no footprint passes through seeds or mud."""


class PlateLoad:
    """Load of a foot on a plate.

    An arc rolls without slipping, so each dome touches the plate at one place, whose distance from
    the middle is the dome's arc length. Load beside the domes acts in the middle.

    Args:
        ground: ground of the scene.
        positions_m: (tiles, 3), positions in the foot frame.
    """

    def __init__(self, ground: Ground, positions_m: Floats) -> None:
        self._ground = ground
        x_m, y_m, z_m = positions_m.T
        if ground.arc_rad is not None:
            x_m = np.hypot(x_m, z_m) * ground.arc_rad
        self.dome_places_m = np.stack([x_m, y_m], axis=1)
        """Position on the plate at which each dome touches it, (tiles, 2)."""

    def compute_vertical_n(self, t_s: Floats) -> Floats:
        """Compute the vertical force under each dome, (n, tiles)."""
        return np.asarray(self._ground.forces_n(t_s) * np.cos(self._ground.tilt_rad(t_s)))

    def compute_wrench(self, t_s: Floats) -> Floats:
        """Compute forces and moments of the whole foot, (n, 6): x, y, z of each."""
        forces_n, tilt_rad = self._ground.forces_n(t_s), self._ground.tilt_rad(t_s)
        up_n, back_n = forces_n * np.cos(tilt_rad), forces_n * np.sin(tilt_rad)
        x_m, y_m = self.dome_places_m.T
        columns = (
            -back_n.sum(axis=1),
            np.zeros(len(t_s)),
            up_n.sum(axis=1) + self._ground.force_beside_domes_n(t_s),
            (up_n * y_m).sum(axis=1),
            -(up_n * x_m).sum(axis=1),
            (back_n * y_m).sum(axis=1),
        )
        return np.stack(columns, axis=1)


def check_plate_usable(instrument: str, scene: Scene) -> None:
    """Check that a plate can measure the load of a scene.

    Args:
        instrument: "force plate" or "pressure plate".
        scene: the scene file.

    Raises:
        UsageError: the plate cannot be used with its ground.
    """
    kinds = _GROUND_KINDS_BY_INSTRUMENT[instrument]
    if scene.ground.kind not in kinds:
        raise UsageError(
            f"a {instrument} under a ground of kind {scene.ground.kind!r} sees nothing of the foot",
            where=f"scene {scene.name}",
            expected=" or ".join(sorted(kinds)),
        )


@dataclass(frozen=True)
class PlateClock:
    """Sample clock of an instrument.

    Attributes:
        rate_hz: nominal sample rate.
        start_s: instant of the first sample, in seconds of the scene.
        drift_ppm: excess of the real rate.
    """

    rate_hz: float
    start_s: float
    drift_ppm: float

    def compute_sample_times(self, end_s: float) -> tuple[Floats, Floats]:
        """Compute the sample times until the scene's `end_s`.

        Returns:
            Times by the instrument, from zero, and by the scene, from `start_s`, both (n,); empty
            if `end_s` is before the start.
        """
        goes = 1.0 + 1e-6 * self.drift_ppm
        n = max(0, int((end_s - self.start_s) * goes * self.rate_hz))
        time_s = np.arange(n) / self.rate_hz
        return time_s, self.start_s + time_s / goes


CHANNELS = ("fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm")
RATE_HZ = 1000.0
RANGE = np.array([125.0, 125.0, 250.0, 12.0, 12.0, 6.0])
"""Range of the channels, either way, in N and N m."""
BITS = 16
NATURAL_HZ, DAMPING = 400.0, 0.05
FILTER_HZ = 300.0
"""Corner frequency of the low-pass filter: Butterworth, second order."""
GAIN = 0.005
"""Largest gain error of a channel, relative."""
CROSSTALK, CROSSTALK_OF_VERTICAL = 0.02, 0.005
"""Largest crosstalk from a force to another, or from a moment to another; from the vertical force.
"""
LEVER_M = 0.0005
"""Largest moment shown per newton."""
WHITE, SLOW = 4e-4, 2e-4
"""Standard deviations of the noise, in parts of the range."""
SLOW_S = 3.0
OFFSET = 4e-3
"""Largest offset after zeroing by hand, in parts of the range."""
CREEP_PER_S = 4e-5
"""Largest drift of that offset, in parts of the range per second."""
STATED_SIGMA_N = 0.25
"""Standard uncertainty of a vertical force of some 20 N after subtraction of the zero, as a user
would combine it: noise, a uniform gain within half a per cent, crosstalk of 2 N."""
DRIFT_PPM = 50.0
LATEST_S = 0.4

Complexes = npt.NDArray[np.complex128]

_FINER = 4  # oversampling of the filters
_PAD_S = 0.1  # lead-in for the filters' transients


@dataclass(frozen=True)
class ForcePlate:
    """Force plate in one trial.

    Attributes:
        clock: clock of the plate.
        sensitivity: (6, 6), sensitivity of each channel to each load.
        offset: (6,), offset at the first sample.
        creep_per_s: (6,), drift of the offset.
    """

    clock: PlateClock
    sensitivity: Floats
    offset: Floats
    creep_per_s: Floats

    @classmethod
    def draw(cls, plate: np.random.Generator, trial: np.random.Generator) -> ForcePlate:
        """Draw a plate's properties and the set-up of a trial, each by its own generator."""
        mixing = np.eye(6) * (1.0 + GAIN * plate.uniform(-1.0, 1.0, 6))
        part = CROSSTALK * plate.uniform(-1.0, 1.0, (6, 6))
        part[:, VERTICAL] *= CROSSTALK_OF_VERTICAL / CROSSTALK
        for kind in (FORCES, MOMENTS):
            own = np.ix_(kind, kind)
            mixing[own] += part[own] * (1.0 - np.eye(3))
        mixing[np.ix_(MOMENTS, FORCES)] += LEVER_M * plate.uniform(-1.0, 1.0, (3, 3))
        return cls(
            clock=PlateClock(
                RATE_HZ,
                start_s=trial.uniform(0.05, LATEST_S),
                drift_ppm=plate.uniform(-DRIFT_PPM, DRIFT_PPM),
            ),
            sensitivity=mixing,
            offset=RANGE * OFFSET * trial.uniform(-1.0, 1.0, 6),
            creep_per_s=RANGE * CREEP_PER_S * trial.uniform(-1.0, 1.0, 6),
        )

    @property
    def delay_s(self) -> float:
        """Delay of slow loads: the spring's and the filter's."""
        return DAMPING / (math.pi * NATURAL_HZ) + math.sqrt(0.5) / (math.pi * FILTER_HZ)

    def simulate_recording(
        self, wrench: Callable[[Floats], Floats], end_s: float, noise: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Simulate a recording of a load until `end_s` of the scene.

        Args:
            wrench: forces and moments at instants of the scene, (n, 6).
            end_s: end of the recording.
            noise: random generator of the noise.

        Returns:
            Times by the plate's clock (n,), and its channels (n, 6).
        """
        time_s, t_s = self.clock.compute_sample_times(end_s)
        shown = self._filter_load(wrench, t_s) @ self.sensitivity.T
        shown += self.offset + time_s[:, None] * self.creep_per_s
        shown += RANGE * WHITE * noise.standard_normal(shown.shape)
        shown += RANGE * SLOW * self._draw_slow_noise(len(time_s), noise)
        step = RANGE / 2 ** (BITS - 1)
        return time_s, np.asarray(np.clip(np.rint(shown / step) * step, -RANGE, RANGE - step))

    def _filter_load(self, wrench: Callable[[Floats], Floats], t_s: Floats) -> Floats:
        """Apply spring and filter to the load, exactly, as both are linear."""
        if not len(t_s):
            return np.zeros((0, 6))
        step_s = 1.0 / (_FINER * self.clock.rate_hz * (1.0 + 1e-6 * self.clock.drift_ppm))
        before = math.ceil(_PAD_S / step_s)
        fine_s = t_s[0] + step_s * np.arange(-before, _FINER * len(t_s))
        load = wrench(np.maximum(fine_s, 0.0))
        i_hz: Complexes = np.asarray(1j * np.fft.rfftfreq(len(fine_s), step_s), np.complex128)
        passed = 1.0 / _second_order(i_hz / NATURAL_HZ, DAMPING)
        passed /= _second_order(i_hz / FILTER_HZ, math.sqrt(0.5))
        spectrum = np.fft.rfft(load, axis=0) * passed[:, None]
        return np.asarray(np.fft.irfft(spectrum, len(fine_s), axis=0)[before::_FINER])

    def _draw_slow_noise(self, n: int, noise: np.random.Generator) -> Floats:
        """Draw noise of unit variance with correlation time `SLOW_S`, linear between knots."""
        decay = math.exp(-0.1)
        knot_s = 0.1 * SLOW_S
        knots = noise.standard_normal((2 + int(n / (self.clock.rate_hz * knot_s)), 6))
        for i in range(1, len(knots)):
            knots[i] = decay * knots[i - 1] + math.sqrt(1.0 - decay**2) * knots[i]
        at = np.arange(n) / (self.clock.rate_hz * knot_s)
        known = np.arange(len(knots))
        return np.stack([np.interp(at, known, column) for column in knots.T], axis=1)


def _second_order(i: Complexes, damping: float) -> Complexes:
    return np.asarray(i**2 + 2.0 * damping * i + 1.0)


PRESSURE_RATE_HZ = 100.0
PITCH_M = 0.005
THRESHOLD_KPA, END_KPA, STEP_KPA = 10.0, 1270.0, 2.5
"""Threshold below which a cell shows zero, largest value, and resolution."""
NOISE_KPA = 1.0
CELL_GAIN, PRESSURE_GAIN = 0.03, 0.01
"""Standard deviations of a cell's gain, and of the whole plate's, relative."""
PLACED_M, TURNED_RAD = 0.0005, math.radians(1.0)
"""Standard deviations of the foot's placement on its mark, by axis, and of its rotation."""
"""Standard uncertainty of a sum of some 9 N: noise and steps of 30 cells, thresholds, gains."""
STATED_COP_SIGMA_M = 0.001
"""Standard uncertainty of a COP coordinate: placement, rotation, cells and their gains."""

_MARGIN_M = 0.02
_DOME_RADIUS_M = 0.0055
_MODULUS_PA = 2.17e6 / (
    1.0 - 0.5**2
)  # modulus of the paper's Vytaflex 60, incompressible, on a rigid plate
_POINTS = 61
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class PressurePlate:
    """Pressure plate in one trial.

    Attributes:
        clock: clock of the plate.
        origin_m: (2,), middle of the first cell, relative to the mark for the foot.
        gains: (cells along x, cells along y), gains of force.
        placed_m: (2,), position of the foot relative to the mark.
        turned_rad: rotation of the foot, to the left.
    """

    clock: PlateClock
    origin_m: Floats
    gains: Floats
    placed_m: Floats
    turned_rad: float

    @classmethod
    def draw(
        cls, places_m: Floats, plate: np.random.Generator, trial: np.random.Generator
    ) -> PressurePlate:
        """Draw a plate around places (tiles, 2), and the placement of the foot in a trial."""
        cells = np.ceil((np.abs(places_m).max(axis=0) + _MARGIN_M) / PITCH_M).astype(int)
        whole = 1.0 + PRESSURE_GAIN * plate.standard_normal()
        return cls(
            clock=PlateClock(
                PRESSURE_RATE_HZ,
                start_s=trial.uniform(0.05, LATEST_S),
                drift_ppm=plate.uniform(-DRIFT_PPM, DRIFT_PPM),
            ),
            origin_m=-PITCH_M * (cells - 0.5),
            gains=whole * (1.0 + CELL_GAIN * plate.standard_normal(2 * cells)),
            placed_m=PLACED_M * trial.standard_normal(2),
            turned_rad=TURNED_RAD * trial.standard_normal(),
        )

    def simulate_recording(
        self, plate_load: PlateLoad, end_s: float, noise: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Simulate a recording of a foot until `end_s` of the scene.

        Returns:
            Times by the plate's clock (n,), and forces (n, cells along x, cells along y).
        """
        time_s, t_s = self.clock.compute_sample_times(end_s)
        cosine, sine = math.cos(self.turned_rad), math.sin(self.turned_rad)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        places_m = plate_load.dome_places_m @ turn + self.placed_m
        bears = self._compute_cell_forces_n(plate_load.compute_vertical_n(t_s), places_m)
        n_per_kpa = 1e3 * PITCH_M**2
        kpa = bears * self.gains / n_per_kpa
        kpa += NOISE_KPA * noise.standard_normal(kpa.shape)
        kpa = np.rint(np.minimum(kpa, END_KPA) / STEP_KPA) * STEP_KPA
        return time_s, np.where(kpa < THRESHOLD_KPA, 0.0, kpa) * n_per_kpa

    def _compute_cell_forces_n(self, vertical_n: Floats, places_m: Floats) -> Floats:
        """Compute the load of each cell, (n, cells along x, cells along y); none off the plate."""
        shape = (len(vertical_n), *self.gains.shape)
        total = np.zeros(math.prod(shape))
        radius_m = compute_patch_radius_m(vertical_n)
        frame = np.arange(len(vertical_n))[:, None]
        for dome, place_m in enumerate(places_m):
            at_m = place_m + radius_m[:, dome, None, None] * _SPREAD
            cell = np.rint((at_m - self.origin_m) / PITCH_M).astype(int)
            inside = ((cell >= 0) & (cell < self.gains.shape)).all(axis=2)
            flat = (frame * shape[1] + cell[..., 0]) * shape[2] + cell[..., 1]
            each_n = np.broadcast_to(vertical_n[:, dome, None] / _POINTS, flat.shape)
            total += np.bincount(flat[inside], each_n[inside], len(total))
        return total.reshape(shape)


def compute_patch_radius_m(force_n: Floats) -> Floats:
    """Compute the radius of a dome's contact patch on a plane under a force."""
    cubed = 0.75 * np.maximum(force_n, 0.0) * _DOME_RADIUS_M / _MODULUS_PA
    return np.asarray(np.minimum(np.cbrt(cubed), _DOME_RADIUS_M))


def _compute_patch_points() -> Floats:
    """Compute points of a patch of radius 1 with equal forces, (points, 2).

    The part 1 - (1 - r^2)^(3/2) of the force is within a radius r (Hertz).
    """
    part = (np.arange(_POINTS) + 0.5) / _POINTS
    radius = np.sqrt(1.0 - (1.0 - part) ** (2.0 / 3.0))
    turn_rad = _GOLDEN_RAD * np.arange(_POINTS)
    points = np.stack([radius * np.cos(turn_rad), radius * np.sin(turn_rad)], axis=1)
    return np.asarray(points - points.mean(axis=0))


_SPREAD = _compute_patch_points()
