"""Tiles with a BMP581, which converts by itself: instants, faults, places, and the bus budget."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.array import startup
from devices.array.free_running import ConversionClock
from devices.array.schedules import compute_frame_s
from devices.array.self_test import WireTiming, measure_conversion_ns
from devices.array.startup import ReadyArray
from devices.buses.i2c import I2cBus, open_bus
from devices.chips import bmp581
from devices.chips.pressure_chips import get_chip
from devices.clock import Clock, VirtualClock
from devices.emulation.chips.bmp581 import EmulatedBmp581
from devices.emulation.world import World
from devices.errors import SceneError
from devices.flags import TileFlag
from devices.frames import TileInfo
from devices.scene.scene_file import Scene, load_scene, replace_chips, validate_scene


def make_scene(name: str = "standing", **tile: Any) -> Scene:
    scene = replace_chips(load_scene(name), "bmp581")
    content = scene.model_dump()
    content["tile"] = [each | tile for each in content["tile"]]
    return validate_scene(content, where="test")


class Rig:
    """An emulated foot of BMP581 tiles, and its array.

    Args:
        scene: scene of the foot.
        has_reference: True: a reference sensor is read, too.
        is_measured: True: the clocks of free-running parts are measured. Else they are known, as to
            poll hundreds of conversions takes longer than most tests.
    """

    def __init__(
        self, scene: Scene, *, has_reference: bool = False, is_measured: bool = False
    ) -> None:
        self.clock = VirtualClock()
        self.world = World(scene, self.clock)
        self.clock.sleep_until_ns(10_000_000)
        bus = open_bus("emulated", self.world.i2c_adapter)
        with pytest.MonkeyPatch.context() as patch:
            if not is_measured:
                patch.setattr(startup, "measure_conversion_ns", self._get_conversion_ns)
            self.ready: ReadyArray = startup.prepare_array(
                bus,
                scene,
                self.clock,
                read_reference_n=self._read_reference_n if has_reference else None,
            )
        self.array = self.ready.array

    def _get_conversion_ns(
        self, bus: I2cBus, clock: Clock, tile: TileInfo, wires: WireTiming
    ) -> int | None:
        serials = [each.serial for each in self.world.scene.tile]
        chip = self.world.chips[serials.index(tile.serial)]
        if isinstance(chip, EmulatedBmp581) and get_chip(tile.chip).is_free_running(tile.settings):
            return chip._conversion_ns()
        return measure_conversion_ns(bus, clock, tile, wires)

    def _read_reference_n(self) -> float:
        now_ns = np.array([self.clock.now_ns()])
        return float(self.world.compute_truth(now_ns).true_force_n[0, 0])

    def chip(self, tile: int) -> EmulatedBmp581:
        chip = self.world.chips[tile]
        assert isinstance(chip, EmulatedBmp581)
        return chip

    def scan(self, frames: int) -> list[list[int]]:
        """Scan frames; return their tile flags."""
        return [self.array.scan_frame().tile_flags for _ in range(frames)]


@given(
    st.floats(0.95, 1.05),
    st.floats(0.0, 1.0),
    st.floats(0.001, 0.02),
    st.floats(-0.001, 0.001),
)
def test_the_clock_of_a_part_is_followed_by_the_number_of_its_conversions(
    factor: float, phase: float, slower: float, measured: float
) -> None:
    """Reads a little slower than conversions bound their ends to the difference."""
    period_ns = 2_000_000 * factor
    clock = ConversionClock(round(period_ns * (1 + measured)))
    read_ns = 1_000_000_000.0
    counted = 0
    errors_ns = []
    for _ in range(3000):
        ended = int((read_ns - phase * period_ns) // period_ns)
        estimated_ns = clock.count_conversions(ended - counted, round(read_ns), round(read_ns))
        errors_ns.append(estimated_ns - (ended + phase) * period_ns)
        counted = ended
        read_ns += period_ns * (1 + slower)
    assert np.abs(errors_ns[2000:]).max() < 0.06 * period_ns


@pytest.mark.parametrize("oversampling", [1, 8])
def test_the_clock_of_each_part_is_measured_at_the_start(oversampling: int) -> None:
    rig = Rig(make_scene(oversampling=oversampling), is_measured=True)
    true_ns = [rig.chip(tile)._conversion_ns() for tile in range(4)]
    assert len(set(true_ns)) == 4
    measured_ns = [1e6 * tile.conversion_ms for tile in rig.ready.tiles]
    assert measured_ns == pytest.approx(true_ns, rel=5e-4)


def test_a_drift_of_the_parts_clock_is_followed() -> None:
    """0.2 % and back in a minute, of reads that are 0.4 % slower, as planned."""
    clock = ConversionClock(2_000_000)
    read_ns, counted = 1_000_000_000.0, 0
    next_ns = read_ns + 1_000_000
    errors_ns = []
    for _ in range(20_000):
        while next_ns <= read_ns:
            end_ns, counted = next_ns, counted + 1
            next_ns += 2_000_000 * (1 + 0.002 * np.sin(2 * np.pi * next_ns / 60e9))
        if counted:
            found_ns = clock.count_conversions(counted, round(read_ns), round(read_ns))
            errors_ns.append(abs(found_ns - end_ns))
        counted = 0
        read_ns += 2_000_000 * 1.004
    assert max(errors_ns[3000:]) < 0.1 * 2_000_000


def test_a_period_that_was_measured_wrongly_is_corrected() -> None:
    period_ns = 2_060_000.0
    clock = ConversionClock(2_000_000)
    read_ns, counted = 1_000_000_000.0, 0
    errors_ns = []
    for _ in range(6000):
        ended = int(read_ns // period_ns)
        end_ns = clock.count_conversions(ended - counted, round(read_ns), round(read_ns))
        errors_ns.append(abs(end_ns - ended * period_ns))
        counted = ended
        read_ns += period_ns * 1.01
    assert max(errors_ns[3000:]) < 0.1 * period_ns


def test_a_pause_behind_the_known_end_may_contain_conversions() -> None:
    clock = ConversionClock(2_000_000)
    clock.set_end(10_000_000)
    assert clock.count_conversions(2, 13_000_000, 13_100_000) == 12_000_000
    assert clock.count_conversions(1, 15_000_000, 15_100_000) == 14_000_000


@pytest.mark.parametrize(("every", "lost_at"), [(1, 1600), (1, 2500), (3, 2500), (6, 2900)])
def test_a_lost_conversion_does_not_move_the_clock(every: int, lost_at: int) -> None:
    """It contradicts the bounds, which would fix a wrong end and then a wrong period."""
    period_ns = 2_001_000.0
    clock = ConversionClock(2_000_000)
    read_ns, counted = 1_000_000_000.0, 0
    errors_ns = []
    for read in range(5000):
        ended = int(read_ns // period_ns)
        count = ended - counted - (read == lost_at)
        end_ns = clock.count_conversions(count, round(read_ns), round(read_ns))
        errors_ns.append(abs(end_ns - ended * period_ns))
        counted = ended
        read_ns += period_ns * (every + 0.002)
    assert max(errors_ns[1500:]) < 0.1 * period_ns


Ends = list[dict[int, int | None]]


def note_ends(rig: Rig) -> Ends:
    """Note the end of each tile's conversions by pressure word; None where one comes again soon."""
    ends_ns: Ends = [{} for _ in rig.world.chips]
    for tile, ends in enumerate(ends_ns):
        chip = rig.chip(tile)
        seen_ns: dict[int, int] = {}

        def note(
            begin_ns: int,
            counts: tuple[int, int],
            _: object,
            ends: dict[int, int | None] = ends,
            chip: EmulatedBmp581 = chip,
            seen_ns: dict[int, int] = seen_ns,
        ) -> None:
            end_ns = begin_ns + chip._conversion_ns()
            is_repeated = end_ns - seen_ns.get(counts[0], 0) < 10 * chip._conversion_ns()
            ends[counts[0]] = None if is_repeated else end_ns
            seen_ns[counts[0]] = end_ns

        chip.on_conversion = note
    return ends_ns


def scan_instant_errors_ns(rig: Rig, ends_ns: Ends, frames: int) -> np.ndarray:
    """Scan frames; return the errors of their usable samples' ends, where these are known."""
    errors_ns = []
    for _ in range(frames):
        scan = rig.array.scan_frame()
        for tile, ends in enumerate(ends_ns):
            osr, iir, _ = rig.array.tiles[tile].settings
            half_ns = bmp581.CONVERSION_P_NS[osr >> 3 & 7] // 2
            lag_ns = (
                bmp581.FILTER_COEFFICIENTS[iir >> 3 & 7] * rig.array._tile_io.conversions_ns[tile]
            )
            estimated_ns = scan.convert_stop_ns[tile] + rig.array.sample_delay_ns[tile]
            estimated_ns += half_ns + lag_ns
            true_ns = ends.get(scan.pressure_raw[tile])
            if true_ns is not None and not scan.tile_flags[tile] & TileFlag.UNUSABLE:
                errors_ns.append(estimated_ns - true_ns)
    assert len(errors_ns) > frames / 2
    return np.array(errors_ns)


@pytest.mark.parametrize("wait_ms", [2.2, 7.0])
def test_samples_have_their_instants_at_an_interval_of_the_scene(wait_ms: float) -> None:
    content = make_scene("rolling").model_dump()
    content["array"] |= {"wait_ms": wait_ms}
    rig = Rig(validate_scene(content, where="test"))
    errors_ns = scan_instant_errors_ns(rig, note_ends(rig), 600)
    assert np.abs(errors_ns).max() < 0.1 * max(rig.array._tile_io.conversions_ns)


@pytest.mark.parametrize(
    ("oversampling", "frames"), [(1, 1000), (4, 300), pytest.param(32, 60, marks=pytest.mark.slow)]
)
def test_samples_of_free_running_tiles_have_their_instants_from_the_first_frame_on(
    oversampling: int, frames: int
) -> None:
    rig = Rig(make_scene("rolling", oversampling=oversampling), is_measured=True)
    errors_ns = scan_instant_errors_ns(rig, note_ends(rig), frames)
    conversion_ns = max(rig.array._tile_io.conversions_ns)
    assert np.abs(errors_ns).max() < 0.1 * conversion_ns, "unfollowed it would be a half"
    assert np.std(errors_ns) < 0.03 * conversion_ns


def test_the_instants_of_commanded_conversions_are_right_in_the_mean() -> None:
    """A conversion starts 0.3 to 1.5 ms after its command, and nothing tells when."""
    rig = Rig(make_scene("rolling", mode="forced"))
    errors_ns = scan_instant_errors_ns(rig, note_ends(rig), 200)
    assert np.abs(errors_ns.mean()) < 200_000
    assert np.std(errors_ns) == pytest.approx(bmp581.START_SPREAD_NS / 12**0.5, rel=0.1)


def test_a_reading_that_is_read_again_has_its_own_instant() -> None:
    """The second reading may be of a later conversion."""
    rig = Rig(make_scene("rolling"))
    ends_ns = note_ends(rig)
    for _ in range(300):
        for health in rig.array.health:
            health._recent.clear()
        assert np.abs(scan_instant_errors_ns(rig, ends_ns, 1)).max() < 300_000


@pytest.mark.parametrize("pause_ms", [10, 60, 100, 1000])
def test_a_pause_in_which_conversions_are_lost_costs_one_frame_and_no_instant(
    pause_ms: int,
) -> None:
    """A part stores 32 conversions, here 64 ms, and drops the oldest without a sign."""
    rig = Rig(make_scene("rolling"))
    ends_ns = note_ends(rig)
    rig.scan(200)
    for _ in range(5):
        rig.clock.sleep_until_ns(rig.clock.now_ns() + pause_ms * 1_000_000)
        before_ns = rig.clock.now_ns()
        errors_ns = scan_instant_errors_ns(rig, ends_ns, 1)
        assert np.abs(errors_ns).max() < 300_000
        assert rig.clock.now_ns() - before_ns < 30_000_000
        assert not any(any(flags) for flags in rig.scan(20))


def test_a_fast_load_and_its_reference_belong_to_the_same_instant() -> None:
    """30 N within 20 ms, so that most readings of a stroke are jumps, and are read again."""
    content = make_scene("indentation").model_dump()
    content["tile"] = content["tile"][:1]
    content["ground"] |= {"stroke_s": 0.02, "repeats": 5}
    content["emulation"] |= {"repeatability": 0.0}
    rig = Rig(validate_scene(content, where="test"), has_reference=True)
    assert rig.ready.choice.schedule == "sequential"
    scans = [rig.array.scan_frame() for _ in range(1400)]
    rows = [i for i, scan in enumerate(scans) if not scan.tile_flags[0]][600:]
    sampled_ns = np.array([scan.convert_stop_ns[0] for scan in scans])
    sampled_ns += rig.array.sample_delay_ns[0]
    true_n = rig.world.compute_truth(sampled_ns).true_force_n[:, 0]
    true_kpa = rig.world.compute_dome_kpa(sampled_ns)[:, 0]
    loaded = [i for i in rows if 1.0 < true_n[i] < 29.0]
    assert len(loaded) > 50
    error_n = [scans[i].reference_n - true_n[i] for i in loaded]
    error_kpa = [scans[i].pressure_raw[0] / bmp581.COUNTS_PER_KPA - true_kpa[i] for i in loaded]
    assert np.median(np.abs(error_n)) < 0.1, "a millisecond would be 1.5 N"
    assert np.percentile(np.abs(error_n), 95) < 0.6
    assert np.median(np.abs(error_kpa)) < 0.05, "a conversion would be 1.5 kPa"
    assert np.percentile(np.abs(error_kpa), 95) < 0.2


def test_a_reference_belongs_to_the_instant_of_a_filtered_pressure() -> None:
    content = make_scene("indentation", filter=31).model_dump()
    content["tile"] = content["tile"][:1]
    content["ground"] |= {"stroke_s": 0.2}
    rig = Rig(validate_scene(content, where="test"), has_reference=True)
    scans = [rig.array.scan_frame() for _ in range(900)][100:]
    sampled_ns = np.array([scan.convert_stop_ns[0] for scan in scans])
    true_n = rig.world.compute_truth(sampled_ns + rig.array.sample_delay_ns[0]).true_force_n[:, 0]
    error_n = np.array([scan.reference_n for scan in scans]) - true_n
    assert np.ptp(true_n) > 5.0
    assert np.percentile(np.abs(error_n), 95) < 0.2


def test_tiles_that_convert_by_themselves_and_others_have_no_common_reference() -> None:
    content = load_scene("indentation").model_dump()
    first, *others = content["tile"]
    content["tile"] = [first | {"chip": "bmp581"}, *others]
    with pytest.raises(SceneError, match="a reference sensor beside"):
        Rig(validate_scene(content, where="test"), has_reference=True)


def test_no_reading_of_a_healthy_array_is_flagged_or_repeated() -> None:
    rig = Rig(make_scene())
    scans = [rig.array.scan_frame() for _ in range(500)]
    assert not any(any(scan.tile_flags) for scan in scans)
    words = [scan.pressure_raw[0] for scan in scans]
    assert sum(a == b for a, b in pairwise(words)) < 10


def make_array_scene(
    tiles: int,
    scl_hz: int = 400_000,
    *,
    temperature_every: int = 1,
    mixed: bool = False,
    **tile: Any,
) -> Scene:
    """Make a scene of some of the grid's tiles, if `mixed` every second one an MPL115A2."""
    content = make_scene("grid", **tile).model_dump(exclude_none=True)
    content["tile"] = content["tile"][:tiles]
    for each in content["tile"][1::2] if mixed else ():
        each |= {"chip": "mpl115a2", "oversampling": 1}
        each.pop("mode", None)
    content["array"] |= {"scl_hz": scl_hz, "temperature_every": temperature_every}
    content |= {"ground": {"kind": "none"}, "rate_hz": 0.0}
    return validate_scene(content, where="test")


@pytest.mark.parametrize(
    ("tiles", "scl_hz", "tile", "published_hz"),
    [
        (4, 400_000, {}, 490),
        (8, 400_000, {"oversampling": 4}, 251),
        (16, 400_000, {"oversampling": 8}, 150),
        pytest.param(64, 400_000, {"oversampling": 32}, 36, marks=pytest.mark.slow),
        (8, 1_000_000, {}, 490),
        (16, 1_000_000, {}, 352),
        pytest.param(64, 1_000_000, {"oversampling": 16}, 85, marks=pytest.mark.slow),
        (4, 400_000, {"mode": "forced"}, 258),
        (16, 400_000, {"mode": "forced"}, 184),
        (4, 400_000, {"mixed": True}, 490),
        (16, 400_000, {"mixed": True, "oversampling": 8}, 153),
        pytest.param(64, 400_000, {"mixed": True, "oversampling": 32}, 44, marks=pytest.mark.slow),
        # Slower than conversions: the stored ones are read, too.
        (16, 400_000, {}, 82),
    ],
)
def test_an_array_reaches_the_rate_that_its_bits_allow(
    tiles: int, scl_hz: int, tile: dict[str, Any], published_hz: float
) -> None:
    rig = Rig(make_array_scene(tiles, scl_hz, **tile))
    predicted_hz = 1 / compute_frame_s(rig.ready.choice.schedule, rig.ready.timing)
    assert predicted_hz == pytest.approx(published_hz, rel=0.02)
    rig.scan(2 * tiles)
    frames = 50 if tiles == 64 else 100
    begin_ns = rig.clock.now_ns()
    assert not any(any(flags) for flags in rig.scan(frames))
    rate_hz = 1e9 * frames / (rig.clock.now_ns() - begin_ns)
    assert rate_hz == pytest.approx(predicted_hz, rel=0.02)


@pytest.mark.slow
def test_an_array_that_loses_conversions_in_every_frame_gives_new_ones_with_their_instants() -> (
    None
):
    """Of 80 conversions between two reads a part stores 32; their number is only estimated."""
    rig = Rig(make_array_scene(64))
    ends_ns = note_ends(rig)
    assert not any(any(flags) for flags in rig.scan(2))
    errors_ns = scan_instant_errors_ns(rig, ends_ns, 20)
    assert np.abs(errors_ns).max() < 1.1 * max(rig.array._tile_io.conversions_ns)
    assert not any(any(flags) for flags in rig.scan(2))


def test_a_rarer_temperature_is_no_fault_and_makes_frames_shorter() -> None:
    rates_hz = []
    for temperature_every in (1, 10):
        rig = Rig(make_array_scene(8, temperature_every=temperature_every))
        rig.scan(20)
        begin_ns = rig.clock.now_ns()
        assert not any(any(flags) for flags in rig.scan(200))
        rates_hz.append(200e9 / (rig.clock.now_ns() - begin_ns))
    assert rates_hz[1] > 1.4 * rates_hz[0]


def test_two_tiles_share_a_channel_without_a_select_between_them() -> None:
    content = make_scene().model_dump()
    content["tile"] = [
        tile | {"channel": index // 2, "address": bmp581.ADDRESSES[index % 2]}
        for index, tile in enumerate(content["tile"])
    ]
    rig = Rig(validate_scene(content, where="test"))
    assert sum(rig.ready.timing.selects) == 2
    assert not any(any(flags) for flags in rig.scan(100))
    pressures = set(rig.array.scan_frame().pressure_raw)
    assert len(pressures) == 4, "each is read at its own address"


@pytest.mark.parametrize("schedule", ["simultaneous", "per_mux"])
def test_a_broadcast_of_free_running_tiles_is_refused(schedule: str) -> None:
    content = make_scene().model_dump()
    content["array"] |= {"schedule": schedule}
    with pytest.raises(SceneError, match="convert by themselves"):
        Rig(validate_scene(content, where="test"))
