"""A node's tares as its frames come: from a lead, in flight, by hand; time is the frames' own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import StorageError, TareError
from devices.flags import FrameFlag, TileFlag
from devices.frames import FrameBatch
from service.estimation.tare.tare import Tare
from service.server.node import ServerNode
from service.sessions.tares import RecordedTare
from storage.intervals import Intervals
from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, UTC_NS, make_array
from tests.builders.calibrations import make_calibration
from tests.builders.frames import make_frames
from tests.builders.hello import make_hello
from tests.storage.faulty_disk import NO_SPACE, refusing

PERIOD_NS = 10_000_000  # 100 Hz
BATCH = 25
COUNTS_PER_K = 2.64  # of a bubble of 100 kPa


class Foot:
    """A node without a server: what it sends, and what became of it."""

    def __init__(self, folder: Path, **scene: Any) -> None:
        self._folder = folder
        self.seq = 0
        self.due: list[int] = []
        info = make_array(nominal_rate_hz=100.0)
        self.hello = make_hello(
            info, make_calibration(*info.serials), scene={"name": "test", **scene}, emulated=True
        )
        self.node: ServerNode
        self.restart()

    def restart(self) -> None:
        """The server goes down and comes up again, and the node connects."""
        if hasattr(self, "node"):
            self.close()
        self.node = ServerNode(self._folder / "node", self._folder / "journal", self.hello)
        self.node.apply_checked_hello(self.hello, UTC_NS)
        self.node.is_connected = True

    def close(self) -> None:
        for stream in self.node.streams.values():
            if stream.journal is not None:
                stream.journal.close()

    def frames(
        self,
        seconds: float,
        counts: Any = 0.0,
        *,
        warmer_k: float = 0.0,
        lead: bool = False,
        silent: int | None = None,
    ) -> FrameBatch:
        """The next frames, so many counts above 500, with noise."""
        n = round(seconds * 1e9 / PERIOD_NS)
        rng = np.random.default_rng(self.seq)
        noisy = rng.normal(0.0, 0.9, (n, 2)) + np.asarray(counts)
        status = np.zeros((n, 2), dtype=np.uint8)
        if silent is not None:
            status[:, silent] = TileFlag.NO_ANSWER
        batch = make_frames(
            np.arange(self.seq, self.seq + n),
            period_ns=PERIOD_NS,
            pressure_raw=500 - np.rint(noisy),
            temperature_raw=round(480 - 5.35 * warmer_k),
            tile_flags=status,
            frame_flags=FrameFlag.LEAD if lead else 0,
        )
        self.seq += n
        return batch

    def send(self, frames: FrameBatch) -> None:
        """Have the server take them."""
        schema = wire_schema(self.hello.array_info)
        for begin in range(0, len(frames), BATCH):
            rows = frames.slice_rows(begin, begin + BATCH)
            now_t_ns = UTC_NS + int(rows.t_mono_ns[-1])
            due = self.node.receive_frames(
                self.node.present_stream, encode_frames(rows, schema), now_t_ns
            )
            self.due += [int(seq) for piece, _ in due for seq in piece.seq]

    def live(self, seconds: float, counts: Any = 0.0, **how: Any) -> None:
        """Take frames and send them."""
        self.send(self.frames(seconds, counts, **how))

    def step(self, times: int = 1, rest: float = 0.0) -> None:
        """Two seconds in the air and one on the ground."""
        for _ in range(times):
            self.live(1.0, rest)
            self.live(1.0, 40.0)
            self.live(1.0, rest)

    @property
    def auto_tare(self) -> str:
        return self.node.estimator.tare_controller.auto_tare_state

    @property
    def warnings(self) -> list[str]:
        return self.node.estimator.tare_controller.list_reasons_to_tare_again()

    @property
    def problem(self) -> str | None:
        return self.node.estimator.tare_controller.missing_tare_reason

    @property
    def tare(self) -> Tare | None:
        return self.node.estimator.live.tare_in_use_unless_lost

    @property
    def tares(self) -> list[RecordedTare]:
        return [*self.node.estimator.tare_history.all_tares_with_undone]

    @property
    def history(self) -> list[tuple[str, bool]]:
        return [(each.tare.source, each.undone) for each in self.tares]

    @property
    def offset_counts(self) -> list[float]:
        assert self.tare is not None
        return list((self.tare.baseline_kpa - UNLOADED_KPA) / COUNT_KPA)


@pytest.fixture
def foot_of(tmp_path: Path) -> Iterator[Any]:
    """A foot; keys of its scene can be given."""
    with ExitStack() as stack:

        def make(**scene: Any) -> Foot:
            foot = Foot(tmp_path, **scene)
            stack.callback(foot.close)
            return foot

        yield make


@pytest.fixture
def foot(foot_of: Any) -> Foot:
    """A foot whose lead of a second has been tared."""
    made: Foot = foot_of()
    made.live(1.0, lead=True)
    made.live(1.0)
    assert made.history == [("lead", False)]
    return made


# --- the lead -------------------------------------------------------------------------------------


def test_a_lead_that_comes_after_what_followed_it_is_tared_all_the_same(foot_of: Any) -> None:
    foot = foot_of()
    lead = foot.frames(1.0, 1.0, lead=True)
    foot.live(2.0, 20.0)
    assert foot.history == []
    assert foot.problem == "not tared: lift the foot, hold it still, and tare"
    foot.send(lead.slice_rows(0, 50))
    assert foot.history == []
    foot.send(lead.slice_rows(50, 100))
    assert foot.history == [("lead", False)]
    assert foot.tare.frames == 100
    assert foot.offset_counts == pytest.approx([1.0, 1.0], abs=0.4)
    assert foot.problem is None


def test_a_lead_of_which_a_part_never_comes_is_tared_from_the_rest(foot_of: Any) -> None:
    foot = foot_of(auto_tare=False)
    foot.live(0.5, lead=True)
    foot.frames(0.25, lead=True)  # lost
    foot.live(0.25, lead=True)
    foot.live(9.0, 20.0)
    assert foot.history == []
    foot.live(2.0, 20.0)
    assert foot.history == [("lead", False)]
    assert foot.tare.frames == 75


def test_a_server_that_is_restarted_in_the_lead_tares_from_all_of_it_and_not_twice(
    foot_of: Any,
) -> None:
    foot = foot_of()
    foot.live(0.5, lead=True)
    foot.restart()
    foot.live(0.5, lead=True)
    foot.live(1.0, 20.0)
    assert foot.history == [("lead", False)]
    assert foot.tare.frames == 100
    foot.restart()
    foot.live(1.0, 20.0)
    assert foot.history == [("lead", False)]
    assert foot.tare is not None


def test_a_lead_that_is_no_tare_is_said_with_its_reason(foot_of: Any) -> None:
    foot = foot_of()
    foot.live(1.0, lead=True, silent=1)
    foot.live(1.0, 20.0)
    assert foot.history == []
    assert foot.problem is not None
    assert "the lead gave no tare (tile T02 has 0 readable frames" in foot.problem
    assert "lift the foot" in foot.problem


def test_without_a_lead_that_could_be_used_the_tare_of_before_stays_and_that_is_said(
    foot: Foot,
) -> None:
    before = foot.tare
    assert before is not None
    again = {"stream_id": "1" * 32}
    info = foot.hello.array_info.model_copy(update=again)
    foot.hello = foot.hello.model_copy(update={"array_info": info})
    foot.node.apply_checked_hello(foot.hello, UTC_NS)
    foot.seq = 0
    foot.live(1.0, lead=True, silent=0)
    foot.live(1.0)
    assert foot.tare is not None
    assert foot.tare.t_ns == before.t_ns
    assert "tile T01 has 0 readable frames" in str(foot.problem)


def test_a_lead_whose_tare_cannot_be_kept_is_a_storage_problem_and_tried_again(
    foot_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    foot = foot_of()
    foot.live(1.0, lead=True)
    with monkeypatch.context() as patch:
        patch.setattr("storage.durable_files.os.fsync", refusing(*NO_SPACE))
        foot.live(1.0)
        assert "No space left" in foot.node.storage_problem
        assert foot.history == []
        assert foot.tare is None
        foot.live(1.0)
    foot.node.storage_problem = None  # as the server does once it can write again
    foot.live(1.0)
    assert foot.history == [("lead", False)]
    assert foot.tare is not None


# --- in flight ------------------------------------------------------------------------------------


def test_a_foot_whose_lead_failed_is_tared_as_soon_as_it_steps(foot_of: Any) -> None:
    foot = foot_of()
    foot.live(1.0, lead=True, silent=1)
    foot.step(4, rest=2.0)
    assert foot.history == [("flight", False)]
    assert foot.offset_counts == pytest.approx([2.0, 2.0], abs=0.6)
    assert foot.problem is None
    assert "between two steps" in foot.tares[0].reason


def test_a_foot_that_stands_from_the_beginning_is_never_tared_unasked(foot_of: Any) -> None:
    foot = foot_of()
    foot.live(1.0, lead=True, silent=1)
    foot.live(60.0, 8.0)
    assert foot.history == []
    assert foot.problem is not None


def test_a_dome_that_warms_is_followed_between_steps_and_each_time_is_in_the_history(
    foot: Foot,
) -> None:
    for minute in range(1, 6):
        warmer_k = 0.4 * minute
        for _ in range(20):
            foot.live(2.0, COUNTS_PER_K * warmer_k, warmer_k=warmer_k)
            foot.live(1.0, COUNTS_PER_K * warmer_k + 40.0, warmer_k=warmer_k)
    flights = [each for each in foot.tares if each.tare.source == "flight"]
    assert 3 <= len(flights) <= 5
    t_s = np.array([each.tare.t_ns for each in foot.tares]) * 1e-9
    assert (np.diff(t_s) >= 60.0 - 1e-6).all()
    assert all(" kPa from the tare before" in t.reason for t in flights)
    assert foot.offset_counts == pytest.approx([COUNTS_PER_K * 2.0] * 2, abs=COUNTS_PER_K * 0.6)
    assert foot.due == list(range(len(foot.due))), "no frame was lost at a tare"


def test_slots_missed_here_and_there_do_not_keep_it_from_following(foot: Foot) -> None:
    for _ in range(250):
        foot.live(0.5, 1.0)
        foot.seq += 2  # 20 ms in which nothing was read
    assert foot.history == [("lead", False), ("flight", False)]


def test_after_a_gap_nobody_knows_where_the_foot_was(foot: Foot) -> None:
    foot.live(50.0, 0.9)
    foot.seq += 2000
    foot.live(0.3, 0.9)
    assert foot.node.estimator.live.airborne_since_t_ns == UTC_NS + (foot.seq - 30) * PERIOD_NS
    assert foot.history == [("lead", False)]
    foot.live(60.0, 0.9)
    assert foot.history == [("lead", False), ("flight", False)]


def test_a_foot_in_contact_is_left_alone_however_long(foot: Foot) -> None:
    foot.live(300.0, 8.0)  # eight newtons on each of two tiles
    assert foot.history == [("lead", False)]


def test_a_light_load_that_stays_is_said_and_not_tared_away(foot: Foot) -> None:
    foot.live(90.0, 2.0)  # below contact: two newtons on each of two tiles
    assert foot.history == [("lead", False)]
    (warning,) = foot.warnings
    assert "a light load, or a baseline that has moved" in warning
    foot.live(20.0)
    assert foot.warnings == []


def test_a_scene_can_turn_it_off(foot_of: Any) -> None:
    foot = foot_of(auto_tare=False)
    foot.live(1.0, lead=True, silent=1)
    foot.step(4)
    assert foot.auto_tare == "off"
    assert foot.history == []
    foot.node.tare_now()
    foot.live(70.0, 1.0)
    assert foot.history == [("unloaded", False)]


def test_an_automatic_tare_that_is_undone_does_not_come_back_until_somebody_tares(
    foot: Foot,
) -> None:
    foot.live(70.0, 0.9)
    assert foot.history == [("lead", False), ("flight", False)]
    assert foot.auto_tare == "on"
    foot.node.estimator.tare_controller.undo_tare(foot.tares[-1].id)
    assert foot.offset_counts == pytest.approx([0.0, 0.0], abs=0.4)
    assert foot.auto_tare == "paused"
    foot.live(200.0, 0.9)
    foot.restart()
    foot.live(70.0, 0.9)
    assert foot.history == [("lead", False), ("flight", True)]
    recorded = foot.node.tare_now("after the break")
    assert recorded.reason == "after the break"
    assert foot.auto_tare == "on"
    foot.live(70.0, 0.0)
    assert [source for source, _ in foot.history] == ["lead", "flight", "unloaded", "flight"]


def test_an_automatic_tare_that_cannot_be_kept_is_not_in_force(
    foot: Foot, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = foot.tare
    monkeypatch.setattr("service.sessions.tares.write_tares", refusing(StorageError, "full"))
    foot.live(70.0, 0.9)
    assert foot.history == [("lead", False)]
    assert foot.tare is before
    assert foot.node.storage_problem == "full"


# --- whether it still fits ------------------------------------------------------------------------


def test_a_foot_that_has_warmed_up_since_its_tare_is_told_of_in_newtons(foot: Foot) -> None:
    assert foot.warnings == []
    foot.live(2.0, 20.0, warmer_k=5.0)
    (warning,) = foot.warnings
    # 5 K of 0.336 kPa/K are 13.2 N on each of two tiles of a newton a count
    assert warning.startswith("the tiles are 5.0 K warmer than when tared")
    assert "about +26." in warning
    foot.live(2.0, 20.0, warmer_k=-2.0)
    (warning,) = foot.warnings
    assert "2.1 K colder" in warning
    foot.live(2.0, warmer_k=0.0, silent=0)
    assert foot.warnings == []  # where a temperature is not known


def test_an_old_tare_is_told_of(foot_of: Any) -> None:
    foot = foot_of(auto_tare=False)
    foot.live(1.0, lead=True)
    foot.live(1.0)
    foot.seq += 31 * 60 * 100
    foot.live(1.0)
    assert foot.warnings == ["tared 31 min ago: lift the foot, hold it still, and tare"]


def test_a_node_without_calibration_is_not_tared_and_frames_pass(foot_of: Any) -> None:
    foot = foot_of()
    foot.hello = foot.hello.model_copy(
        update={"calibration": None, "calibration_problem": "for this test"}
    )
    foot.restart()
    foot.live(1.0, lead=True)
    foot.step(3)
    assert foot.history == []
    with pytest.raises(TareError, match="without a calibration"):
        foot.node.tare_now()
    assert foot.due == list(range(foot.seq))
    assert foot.node.journal is not None
    assert foot.node.journal.stored == Intervals([(0, foot.seq - 1)])
