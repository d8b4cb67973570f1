"""Laws of the list of trials: its text, its order, and its place."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.errors import FootTileError, StateError, UsageError
from service.server.takes import Take
from service.server.trials import ListedTrial, TrialRecorder, format_trials, parse_trials
from storage.sessions.folder import Ledger

_TEXT = st.text(
    st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), min_size=1, max_size=12
)


def _make_trial_or_none(name: str, tags: list[str]) -> ListedTrial | None:
    try:
        return ListedTrial(name=name, tags=tuple(tags))
    except ValidationError:
        return None


TRIALS = st.builds(_make_trial_or_none, _TEXT, st.lists(_TEXT, max_size=3)).filter(bool)


class FakeServer:
    """What a list of trials needs of a server."""

    def __init__(self) -> None:
        self.numbers = itertools.count()
        self.sessions: list[Any] = []
        self.refuses = False

    def start_take_where_possible(self, name: str, nodes: object, **how: Any) -> Take:
        if self.refuses:
            raise StateError("no node is connected")
        take = Take(f"{next(self.numbers):012x}")
        session = SimpleNamespace(id=take.id, name=name, node="bench", take=take.id)
        session.state, session.started_t_ns = "recording", 10**18
        self.sessions.append(session)
        return Take(take.id, cast("Any", [session]))

    def stop(self) -> None:
        for session in self.sessions:
            session.state = "sealed"

    def make(self, path: Path) -> TrialRecorder:
        store = SimpleNamespace(
            list_unsealed=lambda: [s for s in self.sessions if s.state != "sealed"],
            iterate_newest_first=lambda: iter(self.sessions[::-1]),
            find_by_idempotency_key=lambda _: [],
        )
        ledger = Ledger(complete=True, lossy=False, parts=(), missed_slots=0)
        recorder = SimpleNamespace(compute_ledger=lambda _: ledger)
        make: Any = TrialRecorder
        made: TrialRecorder = make(path, self, recorder, store, None, lambda _: None)
        return made


@given(st.lists(TRIALS, max_size=20))
def test_the_text_of_a_list_is_parsed_to_the_list(trials: list[ListedTrial]) -> None:
    assert parse_trials(format_trials(trials)) == tuple(trials)


def test_a_line_is_a_name_with_tags_or_names_with_commas_between() -> None:
    text = "# day 3\r\n\nmud 1; wet, deep\n mud 1, mud 2, plate 1\nleft, slow;\n"
    assert [(one.name, one.tags) for one in parse_trials(text)] == [
        ("mud 1", ("wet", "deep")),
        ("mud 1", ()),
        ("mud 2", ()),
        ("plate 1", ()),
        ("left, slow", ()),
    ]


def test_rows_of_a_spreadsheet_are_names_with_tags() -> None:
    text = "mud 1\twet\tdeep\nmud 2\t\t\n1,5 km/h\tdry\n"
    assert [(one.name, one.tags) for one in parse_trials(text)] == [
        ("mud 1", ("wet", "deep")),
        ("mud 2", ()),
        ("1,5 km/h", ("dry",)),
    ]


def test_a_decimal_comma_never_makes_two_trials_of_one() -> None:
    with pytest.raises(UsageError, match=r"line 2.*'1,5'"):
        parse_trials("# speeds\nwalk 1,5 km/h\n")
    (trial,) = parse_trials("walk 1,5 km/h;\n")
    assert trial.name == "walk 1,5 km/h"


@pytest.mark.parametrize(
    "line", ["; wet", "a,, b", "\twet", "a; b; c\x07", "x" * 201, "a; " + "t" * 101, "\u202ea"]
)
def test_a_bad_line_is_refused_with_its_number(line: str) -> None:
    with pytest.raises(UsageError, match="line 3") as found:
        parse_trials(f"good\n\n{line}\n")
    assert "name; tag, tag" in str(found.value)


@given(
    count=st.integers(1, 6),
    steps=st.lists(
        st.one_of(
            st.sampled_from(["record", "fail", "skip", "repeat", "reopen"]), st.integers(0, 6)
        )
    ),
)
def test_no_order_of_steps_loses_a_row_and_only_a_success_advances(
    tmp_path_factory: pytest.TempPathFactory, count: int, steps: list[str | int]
) -> None:
    path = tmp_path_factory.mktemp("trials") / "trials.json"
    fake = FakeServer()
    trials = fake.make(path)
    names = [f"trial {i}" for i in range(count)]
    trials.set_trials([ListedTrial(name=name) for name in names])
    recorded = [0] * count
    for step in steps:
        before = trials.make_view()
        place = before.next_index
        fake.refuses = step == "fail"
        if step in ("record", "fail"):
            if place == count or step == "fail":
                with pytest.raises(StateError):
                    trials.record_next()
                assert trials.make_view() == before
                continue
            trials.record_next()
            recorded[place] += 1
            number = f" ({recorded[place]})" if recorded[place] > 1 else ""
            assert fake.sessions[-1].name == names[place] + number
            after = trials.make_view()
            assert (after.last_index, after.trials[place].state) == (place, "recording")
            assert place < after.next_index <= count
            with pytest.raises(StateError, match="is being recorded"):
                trials.record_next()
            fake.stop()
        elif step == "reopen":
            trials = fake.make(path)
            assert trials.make_view() == before
        else:
            wanted = {"skip": place + 1, "repeat": before.last_index or 0}.get(str(step), step)
            try:
                trials.change({"next_index": wanted})
            except FootTileError:
                assert int(str(wanted)) > count
            else:
                assert trials.make_view().next_index == wanted
        view = trials.make_view()
        assert [row.name for row in view.trials] == names
        assert [row.recordings for row in view.trials] == recorded
        for i, row in enumerate(view.trials):
            assert (row.state == "complete") == (recorded[i] > 0)
            assert row.state != "skipped" or i < view.next_index


def test_a_longer_list_keeps_what_was_recorded(tmp_path: Path) -> None:
    fake = FakeServer()
    trials = fake.make(tmp_path / "trials.json")
    trials.set_trials(parse_trials("a, b"))
    trials.record_next()
    fake.stop()
    trials.set_trials(parse_trials("a, b, c"))
    view = trials.make_view()
    assert (view.next_name, [row.recordings for row in view.trials]) == ("b", [1, 0, 0])
    trials.set_trials(parse_trials("b, a"))
    view = trials.make_view()
    assert (view.next_name, view.last_index, view.trials[1].recordings) == ("b", 1, 1)
    with pytest.raises(UsageError, match="at most 1000"):
        trials.set_trials([ListedTrial(name="x")] * 1001)


def test_a_list_as_text_keeps_texts_recordings_and_place_of_rows_of_equal_names(
    tmp_path: Path,
) -> None:
    fake = FakeServer()
    trials = fake.make(tmp_path / "trials.json")
    trials.set_trials(
        [ListedTrial(name=name, subject="S1", notes=f"note {name}") for name in "abacd"]
    )
    for _ in range(3):
        trials.record_next()
        fake.stop()
    for text, recordings, place in [
        ("a, b, a, c, d, e", [1, 1, 1, 0, 0, 0], 3),
        ("a\nb; slow\na, c, d, e", [1, 1, 1, 0, 0, 0], 3),  # a tag
        ("a, b, a, x, c, d, e", [1, 1, 1, 0, 0, 0, 0], 3),
        ("a, B, a, c, d, e", [1, 0, 1, 0, 0, 0], 3),
        ("d, a, a", [0, 1, 1], 0),
        ("a, a", [1, 1], 2),
        ("a, a, f", [1, 1, 0], 2),
    ]:
        trials.set_trials(parse_trials(text))
        view = trials.make_view()
        assert ([row.recordings for row in view.trials], view.next_index) == (recordings, place)
        for row in view.trials:
            expected = ("S1", f"note {row.name}") if row.name in "abcd" else ("", "")
            assert (row.subject, row.notes) == expected
    assert len({row.sessions[0] for row in view.trials[:2]}) == 2
    trials.set_trials([ListedTrial(name="a", notes="")])
    (row,) = trials.make_view().trials
    assert (row.subject, row.notes, row.recordings) == ("S1", "", 1)
    trials.set_trials(parse_trials("g, h"))
    assert trials.make_view().next_name == "g"


def test_a_trial_that_ran_when_the_server_was_killed_before_the_list_was_saved_is_adopted(
    tmp_path: Path,
) -> None:
    path = tmp_path / "trials.json"
    fake = FakeServer()
    trials = fake.make(path)
    trials.set_trials(parse_trials("a, b"))
    trials.change({"stop_after_s": 60})
    before = path.read_bytes()
    trials.record_next()
    ran = trials.make_view()
    path.write_bytes(before)
    view = fake.make(path).make_view()
    assert (view.take, view.next_name, view.running_name) == (ran.take, "b", "a")
    assert view.stop_at_t_ns == fake.sessions[0].started_t_ns + 60 * 10**9
    assert fake.make(path).make_view() == view
    path.write_bytes(before)
    fake.sessions[0].take = None  # recorded by hand
    assert fake.make(path).make_view().next_name == "a"


def test_the_running_trial_has_its_name_in_a_list_without_it(tmp_path: Path) -> None:
    fake = FakeServer()
    trials = fake.make(tmp_path / "trials.json")
    trials.set_trials(parse_trials("a, b"))
    trials.record_next()
    trials.set_trials(())
    view = trials.make_view()
    assert (view.running_name, view.last_index, view.trials) == ("a", None, [])
    fake.stop()
    assert trials.make_view().running_name is None


def test_a_damaged_file_is_set_aside_and_named(tmp_path: Path) -> None:
    path = tmp_path / "trials.json"
    FakeServer().make(path).set_trials(parse_trials("a"))
    path.write_text(path.read_text().replace('"a"', '"b"'))
    trials = FakeServer().make(path)
    assert trials.make_view().trials == []
    assert "list of trials" in trials.file_problems[0]
