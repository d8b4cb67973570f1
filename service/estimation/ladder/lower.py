"""The lower part of the ladder: counts to the apparent force on every dome, reading by reading.

Apparent is what the static curve gives, before hysteresis and creep of the rubber are undone.
"""

from __future__ import annotations

import math

from devices.chips.mpl115a2 import PRESSURE_MAX_KPA
from devices.compiled import compiled, inlined
from devices.frames import NOT_READ
from service.estimation.estimates import EstimateStatus
from service.estimation.foot.contact import seeming
from service.estimation.ladder.laws import Laws
from service.estimation.ladder.plan import SUCTION_MAX_KPA, TARE_OLD_NS
from service.estimation.ladder.room import Room
from service.estimation.ladder.unseen import EVENLY, farthest, guess_n, was_away
from service.estimation.models import gas
from service.estimation.models.ambient import around
from service.estimation.models.denoise import AVERAGED_MAX
from service.estimation.models.outliers import is_spike
from service.estimation.models.skew import at_frame
from service.estimation.models.static import curve
from service.estimation.models.temperature import at_tare
from service.estimation.records import Record, Records
from service.estimation.tare.tare import WARMED_COUNTS
from service.estimation.watch.baseline import LOST_KPA, lost
from service.estimation.watch.clip import end_of_range
from service.estimation.watch.repeats import is_stuck
from service.estimation.watch.warmth import moved_kpa

_SATURATED = int(EstimateStatus.SATURATED)
_EXTRAPOLATED = int(EstimateStatus.EXTRAPOLATED)
_OUTLIER_REPLACED = int(EstimateStatus.OUTLIER_REPLACED)
_GAP = int(EstimateStatus.GAP)
_TILE_MISSING = int(EstimateStatus.TILE_MISSING)
_ASSUMED_SCALE = int(EstimateStatus.ASSUMED_SCALE)
_TARE_OLD = int(EstimateStatus.TARE_OLD)
_OVER_RATED = int(EstimateStatus.OVER_RATED)
_TARE_LOST = int(EstimateStatus.TARE_LOST)
_STUCK = int(EstimateStatus.STUCK)
_CLIPPED = int(EstimateStatus.CLIPPED)
_BASELINE_LOST = int(EstimateStatus.BASELINE_LOST)


@inlined
def feel(laws: Laws, scene: Record, tiles: Records, room: Room, i: int) -> None:
    """Work out what the domes feel in row `i`, the next that is only read.

    Args:
        laws: constants of the estimate.
        scene: state of the whole foot.
        tiles: state of the tiles.
        room: with this row as it was taken and, if frames wait for it, the next.
        i: row.
    """
    law, row, n = laws.scene[0], room.rows[i], len(tiles)
    t_ns = room.t_mono_ns[i]
    row.status = _of_frame(law, row)
    # Without a model for the temperature, a tare at another one is old.
    judges_warmth = law.temperature == 0 and law.tare_lost == 0
    after = room.rows[i + 1] if i + 1 < scene.end else row
    has_after = i + 1 < scene.end and after.broken == 0
    head_kpa, outside_kpa, outside = 0.0, 0.0, 0
    all_kpa = 0.0
    for j in range(n):
        if laws.tiles[j].bears == 1:
            all_kpa += room.cells[i, j].kpa - laws.tiles[j].baseline_kpa
    for j in range(n):
        of_tile, cell = laws.tiles[j], room.cells[i, j]
        if judges_warmth and _has_warmed(of_tile, cell):
            row.status |= _TARE_OLD
        after_kpa = room.cells[i + 1, j].kpa if has_after else math.nan
        _judge(law, of_tile, scene, tiles[j], row, cell, after_kpa, all_kpa, n)
        gauge_kpa = cell.kpa - of_tile.baseline_kpa
        # A bare tile beyond the chip's range shows a fault of its own, not the surroundings.
        if of_tile.bears == 0 and cell.over_range == 0 and math.isfinite(gauge_kpa):
            outside_kpa += gauge_kpa
            outside += 1
    if law.ambient == 1:
        mean_kpa = outside_kpa / outside if outside > 0 else math.nan
        head_kpa = around(scene.ambient, mean_kpa, t_ns)
    total_n = known_n = noise_n2 = usable_n = 0.0
    late_ns = 0
    for j in range(n):
        of_tile, cell = laws.tiles[j], room.cells[i, j]
        if of_tile.bears == 0:
            cell.gauge_kpa = cell.kpa - of_tile.baseline_kpa
            continue
        at_ns = room.sampled_ns[i, j]
        slope = _feel_tile(law, of_tile, tiles[j], row, cell, at_ns, t_ns, head_kpa)
        noise_n = abs(slope) * of_tile.noise_kpa
        # A lower bound would be averaged with what is no bound.
        usable = math.nan if cell.beyond == 1 else cell.apparent_n
        room.noise_n[i, j], room.usable_n[i, j] = noise_n, usable
        total_n += cell.apparent_n
        known_n += 0.0 if math.isnan(cell.apparent_n) else cell.apparent_n
        usable_n += usable
        noise_n2 += noise_n**2
        # Of offsets: so many instants may add up to more than there are bits.
        late_ns += at_ns - t_ns
    # Tiles that are known may show contact by themselves.
    judged_n = known_n if math.isnan(total_n) and known_n >= law.on_n else total_n
    seeming(law.on_n, law.off_n, scene.contact, judged_n, t_ns, row.unseen == 1)
    row.loaded, room.since_ns[i] = scene.contact.loaded, scene.contact.since_ns
    room.usable_n[i, n], room.noise_n[i, n] = usable_n, math.sqrt(noise_n2)
    room.sampled_ns[i, n] = t_ns + late_ns // law.bearing


@compiled
def _of_frame(law: Record, row: Record) -> int:
    status = _GAP if row.broken == 1 else 0
    if law.assumed_scale == 1:
        status |= _ASSUMED_SCALE
    if law.tare_lost == 1:
        return status | _TARE_LOST
    return status | _TARE_OLD if row.t_ns - law.tare_ns > TARE_OLD_NS else status


@compiled
def _has_warmed(law: Record, cell: Record) -> bool:
    """Is it warmer or colder than at the tare by more than the baseline can bear?"""
    moved_counts = abs(cell.tadc - law.tare_counts)
    return law.bears == 1 and moved_counts > WARMED_COUNTS and not math.isnan(cell.kpa)


@compiled
def _judge(
    scene_law: Record,
    law: Record,
    scene: Record,
    tile: Record,
    row: Record,
    cell: Record,
    after_kpa: float,
    all_kpa: float,
    tiles: int,
) -> None:
    """What a tile's own readings show to be wrong: repeats, an edge, a single reading far off."""
    as_read = cell.kpa
    if scene_law.watched == 1:
        if law.bears == 1:
            end_of_range(
                tile.clip, as_read, row.t_ns, law.baseline_kpa, law.unloaded_kpa, law.noise_kpa,
                law.noise_left[AVERAGED_MAX], all_kpa - (as_read - law.baseline_kpa),
            )  # fmt: skip
        above_kpa = math.nan if as_read >= law.end_kpa else as_read - law.baseline_kpa
        stuck, scene.toggles = is_stuck(
            scene_law, law.repeats, tile.repeats, cell.padc, above_kpa, law.unloaded_kpa,
            scene.toggles, tiles,
        )  # fmt: skip
        if stuck:
            row.status |= _STUCK
            cell.kpa = math.nan
    if scene_law.waits == 1:
        before_kpa = math.nan if row.broken == 1 else tile.before_kpa
        tile.before_kpa = as_read
        if is_spike(before_kpa, cell.kpa, after_kpa, law.noise_kpa):
            cell.kpa = 0.5 * (before_kpa + after_kpa)
            if law.bears == 1:
                row.status |= _OUTLIER_REPLACED


@compiled
def _feel_tile(
    scene: Record,
    law: Record,
    tile: Record,
    row: Record,
    cell: Record,
    t_ns: int,
    frame_t_ns: int,
    head_kpa: float,
) -> float:
    """What a dome that bears load feels; returns the slope of its curve there in N/kPa."""
    status = 0
    kpa, variance = cell.kpa, law.baseline_variance
    if scene.temperature == 1:
        counts = math.nan if cell.tadc == NOT_READ else float(cell.tadc)
        kpa, sigma_kpa = at_tare(law.temperature, tile.temperature, kpa, counts, t_ns)
        variance += sigma_kpa**2
    if scene.ambient == 1:
        passed_kpa = head_kpa * law.ambient.passed
        kpa -= passed_kpa
        variance += (law.ambient.relative_sigma * passed_kpa) ** 2
    cell.gauge_kpa = kpa - law.baseline_kpa
    if cell.gauge_kpa < -SUCTION_MAX_KPA:  # a torn dome, or another fault
        kpa = math.nan
    # The chip's range is judged by what was read, the calibrated one by what the gas settles at.
    end_kpa = law.chip_end_kpa
    if tile.clip.end_kpa < math.inf:
        end_kpa = min(end_kpa, tile.clip.end_kpa)
        status |= _CLIPPED if cell.kpa > tile.clip.end_kpa else 0
    hidden = cell.kpa > end_kpa
    # As if the chip's end had been read, with what warmth and surroundings have put into it.
    least_kpa = kpa - (cell.kpa - end_kpa if hidden else 0.0)
    settled_kpa, gas_kpa, unseen_kpa = kpa, 0.0, 0.0
    if scene.gas == 1:
        found_kpa, unseen_kpa = _settled(law, tile, kpa, least_kpa, t_ns, hidden)
        gas_kpa = found_kpa - kpa
        # A tile whose bench does not tell of its gas goes without, and is that uncertain.
        settled_kpa = found_kpa if law.gas_known == 1 else kpa
        least_kpa = gas.settled_at_least(law.gas, least_kpa)
    static_kpa = (least_kpa if hidden else settled_kpa) - law.baseline_kpa
    warmed_kpa = lost_kpa = 0.0
    if scene.watched == 1:
        if scene.warms == 1:
            warmed_kpa = moved_kpa(tile.warmth, cell.tadc, law.tare_counts, law.warms_kpa, t_ns)
        seen_kpa = math.nan if hidden else static_kpa
        lost_kpa = lost(tile.baseline, law.even, seen_kpa, variance, warmed_kpa, t_ns)
        if lost_kpa > 0.0 or abs(warmed_kpa) > LOST_KPA:
            status |= _BASELINE_LOST
    variance += lost_kpa**2
    force_n, slope, fit_sigma_n = curve(law.static, static_kpa)
    if math.isnan(cell.kpa if scene.tare_lost == 1 else force_n):
        status |= _TILE_MISSING
    beyond = hidden or static_kpa > law.static.high_kpa
    cell.guess_n = math.nan
    if beyond:
        status |= _SATURATED
        gauge_kpa = settled_kpa - law.baseline_kpa
        cell.guess_n = guess_n(law.unseen, curve(law.static, gauge_kpa)[0], gauge_kpa)
    elif cell.kpa > PRESSURE_MAX_KPA:
        status |= _OVER_RATED
    if static_kpa < law.low_kpa:
        status |= _EXTRAPOLATED
    if scene.skew == 1 and scene.denoise == 0:
        force_n = at_frame(tile.skew, force_n, t_ns, frame_t_ns, row.broken == 1)
    row.status |= status
    cell.apparent_n, cell.beyond = force_n, 1 if beyond else 0
    cell.sigma_n = math.sqrt(slope**2 * variance + fit_sigma_n**2)
    cell.gas_n = slope * law.gas_misfit * gas_kpa
    cell.unseen_gas_n, cell.warm_n = slope * unseen_kpa, slope * warmed_kpa
    return slope


@compiled
def _settled(
    law: Record, tile: Record, kpa: float, least_kpa: float, t_ns: int, hidden: bool
) -> tuple[float, float]:
    """Pressure that the gas settles at, and its uncertainty from what it did unseen.

    What is hidden behind the chip's end is taken as it reads: the best guess, which is no more than
    a guess.
    """
    most_kpa = law.unseen.most_hot_kpa
    taken_kpa = min(kpa, most_kpa) if hidden and not math.isnan(kpa) else kpa
    known = 0.0 < taken_kpa < math.inf and not math.isnan(tile.gas.ln_kpa)
    away = known and was_away(t_ns, tile.gas.t_ns)
    if tile.has_gas_else == 0 and not hidden and not away:
        return gas.settled(law.gas, tile.gas, taken_kpa, t_ns, math.nan), 0.0
    if tile.has_gas_else == 0:
        gas.copy(tile.gas, tile.gas_else)
    found = gas.settled(law.gas, tile.gas, taken_kpa, t_ns, math.nan)
    else_kpa = farthest(taken_kpa, least_kpa, most_kpa) if hidden else kpa
    other = gas.settled(law.gas, tile.gas_else, else_kpa, t_ns, law.unseen.end_hot_kpa)
    tile.has_gas_else = 0 if gas.is_same(tile.gas, tile.gas_else) else 1
    return found, 0.0 if hidden else EVENLY * (other - found)
