"""A bit flipped in the tares that are in force: forces are the same to the bit, or lost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from devices.flags import EstimateFlag
from service.protocol.link import Hello
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.sessions.inputs import SessionFrames, make_inputs
from storage.sessions.folder import SessionsFolder
from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.data_folders import data_folder

_NUMBERS = ("gauge_kpa", "force_n", "force_sigma_n", "grf_n", "grf_sigma_n", "cop_x_m", "cop_y_m")
Numbers = Mapping[str, np.ndarray]


@attack("a bit flipped in tares.json", tries=24, soak_tries=2_600, is_alone=False)
def flipped_tares(play: Play) -> Outcome:
    """A bit is flipped at every byte in turn; then forces are computed live, and a session sealed.

    Failures: a number that is neither bit for bit the one without the flip, nor NaN with bit 512 of
    `estimate_flags`; a flip that is not said.
    """
    outcome = Outcome()
    data = data_folder(play.folder / "data")
    path = data / "nodes" / "left" / "tares.json"
    text = path.read_bytes()
    hello = NodeRegistry(data).get("left").hello
    whole, _ = _estimated(data, hello)
    places = list(range(len(text)))
    play.random.shuffle(places)
    for number in range(play.tries):
        at, bit = places[number % len(places)], play.random.randrange(8)
        for aside in path.parent.glob("tares.json*"):
            aside.unlink()
        path.write_bytes(text[:at] + bytes([text[at] ^ 1 << bit]) + text[at + 1 :])
        now, said = _estimated(data, hello)
        wrong = [name for name in whole if not _is_right_or_lost(whole[name], now[name])]
        if wrong or not said:
            outcome.failed(f"byte {at} bit {bit}: {wrong or 'nothing is said'}")
        elif any(
            (columns["estimate_flags"] & EstimateFlag.TARE_LOST).any() for columns in now.values()
        ):
            outcome.saw("said, and forces are NaN")
        else:
            outcome.saw("said, and the same numbers")
    outcome.figures["bytes of the file"] = str(len(text))
    return outcome


def _estimated(data: Path, hello: Hello) -> tuple[dict[str, Numbers], bool]:
    """Live forces of what a node sent last, and of all its sessions sealed anew."""
    node = ServerNode(data / "nodes" / "left", data / "journal" / "left", hello)
    found: dict[str, Numbers] = {"live": _live(node)}
    for path in sorted((data / "sessions").iterdir()):
        session = SessionsFolder(data / "sessions").load(path.name)
        if session.node == "left":
            session = session.model_copy(update={"state": "pending"})
            inputs = make_inputs(
                session,
                node.make_session_facts(),
                load_tares=lambda: node.estimator.tare_history,
                emulated=node.hello.emulated,
                default_array=node.last_info,
            )
            pieces = [columns for _, columns in SessionFrames(inputs)]
            found[path.name] = _joined(pieces)
    return found, bool(node.file_problems)


def _live(node: ServerNode) -> Numbers:
    journal = node.journal
    assert journal is not None
    due = [
        c
        for batch in journal.read_frames(0, 2**61)
        for _, c in node.estimator.live.estimate_or_pass_frames(batch)
    ]
    return _joined(due)


def _joined(pieces: list[Any]) -> Numbers:
    names = (*_NUMBERS, "estimate_flags")
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def _is_right_or_lost(whole: Numbers, now: Numbers) -> bool:
    lost = (now["estimate_flags"] & EstimateFlag.TARE_LOST) != 0
    for name in _NUMBERS:
        rows = whole[name].reshape(len(whole[name]), -1), now[name].reshape(len(now[name]), -1)
        if rows[0].shape != rows[1].shape or rows[0][~lost].tobytes() != rows[1][~lost].tobytes():
            return False
        if not np.isnan(rows[1][lost]).all():
            return False
    return True
