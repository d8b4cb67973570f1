"""What happens in a round: drawn from its seed, or chosen. Pure: nothing is done here."""

# ruff: noqa: S311  # seeded on purpose: a round can be run again

from __future__ import annotations

import random
from dataclasses import dataclass

MIB = 1 << 20
SMALL_DISK_BYTES = 48 * MIB

ANYTIME = {
    "kill_node": 4,
    "kill_server": 4,
    "kill_both": 3,
    "kill_acquisition": 2,
    "kill_node_parent": 2,
    "power_node": 5,
    "power_server": 5,
    "power_both": 4,
    "cut_link": 4,
    "black_hole": 3,
    "corrupt_link": 3,
    "throttle_link": 2,
    "delay_link": 1,
    "restart_node_twice": 2,
    "slow_fsync": 2,
    "clock_of_node": 1,
    "clock_of_server": 1,
    "hold_up_node": 2,
    "hold_up_server": 1,
}
"""Faults that may come in any number and order, and how often each is drawn."""

AT_THE_END = {
    "stop_while_away": 3,
    "stop_while_away_and_kill_node": 2,
    "kill_while_sealing": 4,
    "power_while_sealing": 4,
}
"""Faults at the end of a recording."""

ALONE = {
    "kill_node": 3,
    "kill_node_parent": 2,
    "kill_acquisition": 2,
    "power_node": 4,
    "restart_node_twice": 2,
    "slow_fsync": 1,
    "clock_of_node": 1,
    "hold_up_node": 1,
}
"""Faults of a node that has no server."""

AT_THE_END_ALONE = {"kill_and_recover": 1, "power_and_recover": 1}
"""What `foottile recover` is for."""

FULL = {"full_disk_of_server": 1, "full_disk_of_node": 1}
"""They need a small disk to be mounted, so somebody who may."""

_END_SHARE = 0.35
_ALONE_SHARE = 0.15


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: a name of `ANYTIME`, `AT_THE_END` or `FULL`.
        after_s: how long all is well before it.
        length_s: how long it lasts, or what it takes down stays down.
        amount: 0 to 1: how bad, where there is something to choose.
    """

    kind: str
    after_s: float = 0.6
    length_s: float = 0.5
    amount: float = 0.5


@dataclass(frozen=True)
class Story:
    """One round."""

    seed: int
    faults: tuple[Fault, ...]
    tiles: int = 4
    pre_roll_s: float = 0.0
    in_the_end_s: float = 0.4
    """How long all is well before the recording is stopped."""
    alone: bool = False
    """Without a server: the node records by itself."""

    @property
    def title(self) -> str:
        """Its faults."""
        return ("alone: " if self.alone else "") + ", ".join(fault.kind for fault in self.faults)

    @property
    def small_disk_of(self) -> str:
        """`server` or `node`, whose disk has to be a small one; else nothing."""
        kinds = [fault.kind for fault in self.faults if fault.kind in FULL]
        return kinds[0].rsplit("_", 1)[1] if kinds else ""


def draw_story(seed: int, *, may_mount: bool) -> Story:
    """The story of a seed: one to three faults.

    Args:
        seed: of everything that is drawn in the round.
        may_mount: may disks be filled?
    """
    rng = random.Random(seed)
    number = rng.choices((1, 2, 3), (5, 4, 1))[0]
    alone = rng.random() < _ALONE_SHARE
    kinds = dict(ALONE if alone else ANYTIME)
    if may_mount:
        kinds |= {"full_disk_of_node": 1} if alone else FULL
    chosen: list[str] = []
    for _ in range(number):
        chosen.append(_drawn(rng, kinds))
        if chosen[-1] in FULL:
            kinds = {kind: weight for kind, weight in kinds.items() if kind not in FULL}
    if rng.random() < _END_SHARE:
        chosen[-1] = _drawn(rng, AT_THE_END_ALONE if alone else AT_THE_END)
    return Story(
        seed=seed,
        alone=alone,
        tiles=rng.choice((4, 4, 8)),
        pre_roll_s=rng.choice((0.0, 0.0, 0.5)),
        in_the_end_s=rng.uniform(0.0, 0.8),
        faults=tuple(
            Fault(
                kind=kind,
                after_s=rng.uniform(0.1, 1.2),
                length_s=_length_s(rng, kind),
                amount=rng.random(),
            )
            for kind in chosen
        ),
    )


def _drawn(rng: random.Random, kinds: dict[str, int]) -> str:
    return rng.choices(list(kinds), list(kinds.values()))[0]


def _length_s(rng: random.Random, kind: str) -> float:
    if kind in ("cut_link", "black_hole", "hold_up_node", "hold_up_server"):
        return rng.choice((rng.uniform(0.5, 2.0), rng.uniform(2.0, 5.0)))
    if kind in ("kill_server", "power_server", "kill_both", "power_both"):
        return rng.uniform(0.0, 0.8)
    return rng.uniform(0.0, 1.5)
