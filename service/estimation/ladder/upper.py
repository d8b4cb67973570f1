"""The upper part of the ladder: force on every dome once the look-ahead is there, GRF and COP.

Whatever is summed here is summed over tiles, one after the other.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import compiled, inlined
from service.estimation.ladder.laws import Laws
from service.estimation.ladder.room import Room
from service.estimation.ladder.unseen import EVENLY, farthest, was_away
from service.estimation.models import denoise, flow, hysteresis, rubber
from service.estimation.records import Record, Records, record_type

BOUND_SIGMAS = 2.33
"""A stated bound lies so many standard uncertainties below: one in a hundred is above the truth."""
PARTS = 8
"""Parts of an uncertainty that all tiles share: corrections of gas and rubber, what either did
unseen, what averages smooth away of the load, warmth that nothing corrects, when the bench's
reference was read, and whether the ground pushes along the axes of tiles or along the segment."""


BORNE = record_type(
    [
        # Force; if `beyond`, what it is at least if nothing is uncertain. NaN where nothing is
        # known, or of a tile that bears no load.
        ("force_n", np.float64),
        ("sigma_n", np.float64),  # its standard uncertainty
        ("own_n", np.float64),  # the part of it that is every tile's own
        ("common_n", np.float64, (PARTS,)),  # the rest, signed: all tiles share the error
        ("beyond", np.int64),  # is the force only a bound?
        ("noise_n", np.float64),  # what averages leave of the noise
        ("bend_n", np.float64),  # how far an average is from that of a window of half the length
        ("of_bend_n", np.float64),  # standard deviation that noise gives that
        ("smoothed_n", np.float64),  # what averages smooth away, as far as the sum of tiles shows
        ("upright", np.float64),  # part of the force that is vertical
        ("weight", np.float64),  # in a sum over tiles
    ]
)
"""What a tile bears in one frame."""


@inlined
def bear(
    laws: Laws,
    tiles: Records,
    room: Room,
    i: int,
    rows: tuple[int, int],
    windows: denoise.Scratch,
    borne: Records,
) -> bool:
    """Work out what the tiles bear in row `i`.

    Args:
        laws: constants of the estimate.
        tiles: state of the tiles.
        room: with this row, those that windows reach back to, and those within the look-ahead.
        i: row.
        rows: oldest and newest that windows may reach.
        windows: scratch of `denoise`.
        borne: (tiles,), the answer.

    Returns:
        Has what was unseen left more than the noise of a reading in any tile?
    """
    scene, n = laws.scene[0], len(tiles)
    for j in range(n):
        now = borne[j]
        now.force_n = room.cells[i, j].apparent_n if laws.tiles[j].bears == 1 else math.nan
        now.noise_n, now.smoothed_n = room.noise_n[i, j], 0.0
    if scene.denoise == 1:
        average(laws, room, i, rows, windows, borne)
    unsettled = False
    for j in range(n):
        law, cell = laws.tiles[j], room.cells[i, j]
        if law.bears == 1:
            at_ns = room.t_mono_ns[i] if _at_frame(scene) else room.sampled_ns[i, j]
            left_n = _bear_tile(scene, law, tiles[j], cell, borne[j], at_ns)
            unsettled = unsettled or (cell.beyond == 0 and left_n > room.noise_n[i, j])
    return unsettled


@compiled
def _at_frame(scene: Record) -> bool:
    """Are averages evaluated at the frame's instant, and not at each tile's?"""
    return bool(scene.skew == 1 and scene.denoise == 1)


@compiled
def _bear_tile(
    scene: Record, law: Record, tile: Record, cell: Record, now: Record, at_ns: int
) -> float:
    """What a tile bears, from its averaged force; returns what was unseen may have left, in N."""
    averaged_n, unseen_n = now.force_n, 0.0
    force_n = averaged_n
    if scene.hysteresis == 1 or scene.rubber == 1:
        force_n, unseen_n = _undone(scene, law, tile, cell, averaged_n, at_ns)
    rate = _rate(tile, force_n, at_ns)
    own_n = math.sqrt(now.noise_n**2 + cell.sigma_n**2 + (rate * law.late_sigma_s) ** 2)
    common_n = now.common_n
    common_n[0], common_n[1] = cell.gas_n, law.rubber_misfit * (force_n - averaged_n)
    common_n[2], common_n[3] = cell.unseen_gas_n, unseen_n
    common_n[4], common_n[5] = now.smoothed_n, cell.warm_n
    common_n[6], common_n[7] = rate * law.late_common_s, law.tilted * force_n
    variance = own_n**2
    for part in range(PARTS - 1):
        variance += common_n[part] ** 2
    now.force_n, now.own_n, now.sigma_n, now.beyond = (
        force_n,
        own_n,
        math.sqrt(variance),
        cell.beyond,
    )
    _as_mounted(law, now)
    return math.sqrt(cell.unseen_gas_n**2 + unseen_n**2)


@compiled
def _as_mounted(law: Record, now: Record) -> None:
    """From newtons of the dome to those of the ground on the tile's part of the foot."""
    if law.gain == 1.0 and law.gain_sigma == 0.0:
        return
    of_gain_n = law.gain_sigma * now.force_n
    now.force_n *= law.gain
    now.own_n = math.hypot(law.gain * now.own_n, of_gain_n)
    now.sigma_n = math.hypot(law.gain * now.sigma_n, of_gain_n)
    for part in range(PARTS):
        now.common_n[part] *= law.gain


@inlined
def average(
    laws: Laws,
    room: Room,
    i: int,
    rows: tuple[int, int],
    windows: denoise.Scratch,
    borne: Records,
) -> None:
    """Forces without their noise. Windows of the sum of all tiles bound those of each.

    Tiles bear the same load. What shakes it, or lets it go, is above the noise of their sum before
    it is above the noise of any of them, and what each would smooth away a little of is missing in
    the GRF as often as there are tiles.
    """
    scene, n, within = laws.scene[0], len(laws.tiles), denoise.ANYWHERE
    columns = room.usable_n, room.noise_n, room.sampled_ns, room.run
    at_frame, frame_ns = _at_frame(scene), room.t_mono_ns[i]
    if scene.bearing > 1 and not math.isnan(room.usable_n[i, n]):
        at_ns = frame_ns if at_frame else room.sampled_ns[i, n]
        _, within = denoise.averaged(columns, i, n, at_ns, rows, scene.noise_left, within, windows)
    for j in range(n):
        now, law = borne[j], laws.tiles[j]
        now.bend_n = math.nan
        if law.bears == 0 or math.isnan(room.usable_n[i, j]):
            continue
        at_ns = frame_ns if at_frame else room.sampled_ns[i, j]
        (now.force_n, left, now.bend_n, of_bend), _ = denoise.averaged(
            columns, i, j, at_ns, rows, law.noise_left, within, windows
        )
        now.of_bend_n = now.noise_n * math.sqrt(of_bend)
        now.noise_n *= math.sqrt(left)
    denoise.share_bend(borne)


@compiled
def _undone(
    scene: Record, law: Record, tile: Record, cell: Record, force_n: float, at_ns: int
) -> tuple[float, float]:
    """Force without loop and creep, and its uncertainty from what the dome did unseen."""
    beyond, away = cell.beyond == 1, False
    if scene.rubber == 1:
        last = tile.dome.rubber
        away = not math.isnan(last.force_n) and was_away(at_ns, last.t_ns)
    elif scene.flow == 1:
        last_of_flow = tile.dome.flow
        away = not math.isnan(last_of_flow.force_n) and was_away(at_ns, last_of_flow.t_ns)
    away = away and not math.isnan(force_n)
    borne_n = cell.guess_n if beyond else math.nan
    if tile.has_dome_else == 0 and not beyond and not away:
        found_n = _without_loop_and_creep(scene, law, tile.dome, force_n, at_ns, borne_n, math.nan)
        return found_n, 0.0
    if tile.has_dome_else == 0:
        _copy(tile.dome, tile.dome_else)
    found_n = _without_loop_and_creep(scene, law, tile.dome, force_n, at_ns, borne_n, math.nan)
    if beyond:
        borne_n = farthest(cell.guess_n, cell.apparent_n, law.unseen.most_n)
    other_n = _without_loop_and_creep(
        scene, law, tile.dome_else, force_n, at_ns, borne_n, law.unseen.end_n
    )
    tile.has_dome_else = 0 if _is_same(scene, tile.dome, tile.dome_else) else 1
    if beyond:
        return other_n if other_n < found_n else found_n, 0.0
    return found_n, EVENLY * (other_n - found_n)


@compiled
def _without_loop_and_creep(
    scene: Record,
    law: Record,
    dome: Record,
    force_n: float,
    at_ns: int,
    borne_n: float,
    away_n: float,
) -> float:
    if scene.flow == 1:
        force_n = flow.compensated(law.flow, dome.flow, force_n, at_ns, borne_n, away_n)
    if scene.hysteresis == 1:
        force_n = hysteresis.compensated(law.hysteresis, dome.hysteresis, force_n, borne_n)
    if scene.rubber == 1:
        force_n = rubber.compensated(law.rubber, dome.rubber, force_n, at_ns, borne_n, away_n)
    return force_n


@compiled
def _copy(dome: Record, to: Record) -> None:
    to.flow.stress_n, to.flow.force_n, to.flow.t_ns = (
        dome.flow.stress_n,
        dome.flow.force_n,
        dome.flow.t_ns,
    )
    to.rubber.force_n, to.rubber.t_ns = dome.rubber.force_n, dome.rubber.t_ns
    for m in range(len(dome.rubber.crept_n)):
        to.rubber.crept_n[m] = dome.rubber.crept_n[m]
    for m in range(len(dome.hysteresis.plays_n)):
        to.hysteresis.plays_n[m] = dome.hysteresis.plays_n[m]


@compiled
def _is_same(scene: Record, one: Record, other: Record) -> bool:
    """Do both remember the same of the models that are named?"""
    for m in range(len(one.hysteresis.plays_n)):
        if one.hysteresis.plays_n[m] != other.hysteresis.plays_n[m]:
            return False
    if scene.flow == 1 and (
        one.flow.stress_n != other.flow.stress_n
        or one.flow.force_n != other.flow.force_n
        or one.flow.t_ns != other.flow.t_ns
    ):
        return False
    if scene.rubber == 0:
        return True
    for m in range(len(one.rubber.crept_n)):
        if one.rubber.crept_n[m] != other.rubber.crept_n[m]:
            return False
    forces = one.rubber.force_n == other.rubber.force_n
    return bool(forces and one.rubber.t_ns == other.rubber.t_ns)


@compiled
def _rate(tile: Record, force_n: float, at_ns: int) -> float:
    """How fast the force rises since the frame before in N/s; 0 where that is not known."""
    rise_n, step_s = force_n - tile.last_n, 1e-9 * (at_ns - tile.last_ns)
    known = tile.has_last == 1 and math.isfinite(rise_n) and step_s > 0.0
    tile.last_n, tile.last_ns, tile.has_last = force_n, at_ns, 1
    return rise_n / step_s if known else 0.0


@inlined
def sigma_of_sum(borne: Records) -> float:
    """Of a sum over the tiles by `weight`: own parts add as squares, others as is.

    A tile without weight may be unknown.
    """
    variance = 0.0
    shared = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # `PARTS`, in registers
    for j in range(len(borne)):
        weight, common_n = borne[j].weight, borne[j].common_n
        if weight != 0.0:
            variance += (weight * borne[j].own_n) ** 2
            shared = (
                shared[0] + weight * common_n[0],
                shared[1] + weight * common_n[1],
                shared[2] + weight * common_n[2],
                shared[3] + weight * common_n[3],
                shared[4] + weight * common_n[4],
                shared[5] + weight * common_n[5],
                shared[6] + weight * common_n[6],
                shared[7] + weight * common_n[7],
            )
    for part in range(PARTS):
        variance += shared[part] * shared[part]
    return math.sqrt(variance)
