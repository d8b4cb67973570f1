"""List of trials: rows that are recorded one after the other, by a press or by the foot's contact.

List, place and the end of the running trial are one file of the data folder, so that they survive
a restart; that the server waits for a contact does not.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, StringConstraints, ValidationError

from devices.clock import server_utc_ns
from devices.errors import FileFormatError, FootTileError, StateError, StorageError, UsageError
from devices.flags import CONTACT_UNKNOWN
from devices.types import StrictModel, check_user_name, check_user_text
from service.protocol.live import TrialState, TrialsView, TrialView
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.recorder import Recorder
from service.server.session_store import SessionStore
from service.server.takes import Take, TakeRecorder
from storage.documents import read_document, write_document
from storage.durable_files import try_set_aside_and_describe
from storage.intervals import NO_END
from storage.sessions.folder import IdempotencyRecord, Session

log = logging.getLogger("foottile.trials")

TRIALS_MAX = 1000
STOP_AFTER_S_MAX = 3600
PRE_ROLL_S = 1.0
"""Pre-roll of a trial that a contact starts."""
_NAME_LENGTH_MAX = 200
_RULE = "`name; tag, tag`, a tab for `;`, or names with commas between"


_TrialName = Annotated[
    str,
    StringConstraints(
        strip_whitespace=True, min_length=1, max_length=_NAME_LENGTH_MAX, pattern="^[^;#][^;]*$"
    ),
    AfterValidator(check_user_name),
]
_TrialTag = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=100, pattern="^[^,]*$"),
    AfterValidator(check_user_name),
]


class ListedTrial(StrictModel):
    """Row of the list: description of the sessions to record."""

    name: _TrialName = Field(examples=["mud 1"])
    tags: Annotated[tuple[_TrialTag, ...], Field(max_length=50)] = ()
    subject: Annotated[str, Field(max_length=200), AfterValidator(check_user_name)] = ""
    notes: Annotated[str, Field(max_length=10_000), AfterValidator(check_user_text)] = ""


class _StoredTrial(ListedTrial):
    takes: tuple[str, ...] = ()
    """Takes in which it was recorded, the latest last."""


class _StoredTrials(StrictModel):
    trials: tuple[_StoredTrial, ...] = ()
    next_index: int = 0
    node: str | None = None
    start_at_contact: bool = False
    stop_after_s: float | None = None
    take: str | None = None
    """Latest take."""
    stop_at_t_ns: int | None = None
    """Time at which that take is stopped, server's UTC."""


def parse_trials(text: str) -> tuple[ListedTrial, ...]:
    """Parse a text: a trial a line, `name; tag, tag`; a line without `;` may name several trials.

    The tabs of a spreadsheet stand for `;` and commas. A comma between digits of several names is
    refused: it may be a decimal one. Empty lines, and lines that begin with `#`, are ignored.

    Raises:
        UsageError: a line is no trial.
    """
    trials: list[ListedTrial] = []
    for number, line in enumerate(text.removeprefix("\ufeff").replace("\r\n", "\n").split("\n"), 1):
        if not line.strip() or line.strip().startswith("#"):
            continue
        row = line.rstrip().replace("\t", ";", 1).replace("\t", ",")
        names, has_tags, tags = row.partition(";")
        if not has_tags and (decimal := re.search(r"\d,\d", names)):
            raise UsageError(
                f"{line.strip()[:80]!r}: is the comma in {decimal[0]!r} of a number, or between "
                "two trials?",
                where=f"line {number}",
                expected="a `;` behind a name with commas, or a space behind each comma",
            )
        try:
            trials += [
                ListedTrial(name=name, tags=tuple(tag for tag in tags.split(",") if tag.strip()))
                for name in ([names] if has_tags else names.split(","))
            ]
        except ValidationError as error:
            first = error.errors()[0]
            raise UsageError(
                f"{line.strip()[:80]!r} is no trial: {first['loc'][0]}: {first['msg']}",
                where=f"line {number}",
                expected=_RULE,
            ) from error
    return tuple(trials)


def _number_names(trials: Sequence[ListedTrial]) -> list[tuple[str, int]]:
    """Return each row's name and its number among rows of that name."""
    names = [one.name for one in trials]
    return [(name, names[:i].count(name)) for i, name in enumerate(names)]


def format_trials(trials: Sequence[ListedTrial]) -> str:
    """Return the text that `parse_trials` reads; subjects and notes are not in it."""
    return "".join(
        f"{one.name}; {', '.join(one.tags)}".rstrip() + "\n"
        if one.tags or "," in one.name
        else f"{one.name}\n"
        for one in trials
    )


class TrialRecorder:
    """List of trials, and the recording of its rows.

    Args:
        path: file of the list.
        takes: starts and stops the takes.
        recorder: computes the sessions' ledgers.
        store: all sessions.
        nodes: all nodes.
        on_change: called after a change, with the sessions that were started or stopped.

    Raises:
        StorageError: the file cannot be read now.
    """

    def __init__(
        self,
        path: Path,
        takes: TakeRecorder,
        recorder: Recorder,
        store: SessionStore,
        nodes: NodeRegistry,
        on_change: Callable[[Sequence[Session]], None],
    ) -> None:
        self._path, self._takes, self._recorder = path, takes, recorder
        self._store, self._nodes, self._on_change = store, nodes, on_change
        self._list = _StoredTrials()
        self._is_armed = False
        self._armed_by: IdempotencyRecord | None = None
        self._contacts: dict[str, int] = {}
        """Last known contact since it was armed, by node."""
        self._problem: str | None = None
        self.file_problems: list[str] = []
        """Damage found, and the consequence, as text."""
        try:
            self._list = read_document(path, _StoredTrials)
        except FileNotFoundError:
            pass
        except FileFormatError as error:
            self.file_problems = [f"list of trials: {try_set_aside_and_describe(path, error)}"]
        for session in store.list_unsealed():
            # The server was killed after it began to record this row, before the list was saved.
            is_next = session.state == "recording" and session.name == self._next_name
            if is_next and session.take is not None and not self.is_in_list(session):
                self._note_take(session.take, session.started_t_ns)

    def set_trials(self, trials: Sequence[ListedTrial]) -> None:
        """Replace the list, and keep the place; rows of equal names keep their recordings.

        Fields that a new row does not set are those of the former row, as subject and notes of a
        list that was read as text. Of rows with one name the first belongs to the first, and so on.

        Raises:
            UsageError: it is too long.
            StorageError: it cannot be saved; the former one stays.
        """
        if len(trials) > TRIALS_MAX:
            raise UsageError(f"the list has {len(trials)} trials", expected=f"at most {TRIALS_MAX}")
        keys, stored = _number_names(trials), self._list
        former = dict(zip(_number_names(stored.trials), stored.trials, strict=True))
        rows = tuple(
            _StoredTrial(**former.get(key, one).model_dump() | one.model_dump(exclude_unset=True))
            for key, one in zip(keys, trials, strict=True)
        )
        # The next row, or the first open one behind it that is still there.
        ahead = list(former)[stored.next_index :]
        left = ahead[:1] + [key for key in ahead[1:] if not former[key].takes]
        places = {key: i for i, key in enumerate(keys)}
        place = next((places[key] for key in left if key in places), len(rows))
        while place and keys[place - 1] not in former:  # rows that were put in before it
            place -= 1
        self._save(trials=rows, next_index=place)
        self._on_change(())

    def change(self, changes: Mapping[str, Any]) -> None:
        """Change settings or the place.

        `is_armed`, or `start_at_contact` false, also ends the waiting for a contact.

        Args:
            changes: values by field of the stored list, or `is_armed`.

        Raises:
            UnknownError: the node does not exist.
            UsageError: the place is not in the list.
            StorageError: it cannot be saved; nothing has changed then.
        """
        if isinstance(node := changes.get("node"), str):
            self._nodes.get(node)
        if changes.get("next_index", 0) > len(self._list.trials):
            raise UsageError(
                f"there is no row {changes['next_index']}",
                expected=f"0 to {len(self._list.trials)}",
            )
        disarms = "is_armed" in changes or changes.get("start_at_contact") is False
        self._save(**{name: value for name, value in changes.items() if name != "is_armed"})
        self._is_armed &= not disarms
        self._on_change(())

    def record_next(self, request: IdempotencyRecord | None = None) -> None:
        """Record the next row, or wait for a contact to do so; a repeated request does nothing.

        Raises:
            StateError: no row is left, a trial is being recorded, or no node can be recorded.
            UsageError: the key came with another request before.
        """
        if self._store.find_by_idempotency_key(request):
            return
        self._check_can_record()
        self._problem = None
        if self._list.start_at_contact:
            self._is_armed, self._armed_by = True, request
            self._contacts.clear()
            self._on_change(())
        else:
            self._start(0.0, request)

    def start_at_contact(self, node: ServerNode, batches: Sequence[EstimatedBatch]) -> None:
        """Start the next row if it waits for a contact and one begins in these frames."""
        if not self._is_armed or self._list.node not in (None, node.name):
            return
        for frames, columns in batches:
            contacts = columns.get("contact", np.empty(0))
            known = contacts[contacts != CONTACT_UNKNOWN]
            if not len(known):
                continue
            before = self._contacts.get(node.name, int(known[0]))
            self._contacts[node.name] = int(known[-1])
            if np.any(np.diff(np.concatenate([[before], known]).astype(int)) > 0):
                age_s = ((node.last_t_ns or 0) - int(frames.t_ns[0])) * 1e-9
                try:
                    self._check_can_record()
                    self._start(PRE_ROLL_S + age_s, self._armed_by)
                except FootTileError as error:
                    self._disarm(str(error))
                return

    def advance(self) -> None:
        """Stop the running trial when its time is over; stop waiting while no node is connected."""
        stored = self._list
        if server_utc_ns() >= (stored.stop_at_t_ns or NO_END) and (running := self._list_running()):
            self._takes.stop_take(str(stored.take))
            self._on_change(running)
        if self._is_armed and not any(
            node.is_connected for node in self._nodes if stored.node in (None, node.name)
        ):
            self._disarm("no node is connected")

    def make_view(self) -> TrialsView:
        """Return the present list, for answers and subscribers."""
        stored = self._list
        row_by_take = {row.takes[-1]: i for i, row in enumerate(stored.trials) if row.takes}
        sessions: dict[int, list[Session]] = {}
        for session in self._store.iterate_newest_first() if row_by_take else ():
            if (i := row_by_take.get(session.take or "")) is not None:
                sessions.setdefault(i, []).append(session)
        running = self._list_running()
        return TrialsView(
            trials=[
                self._make_trial_view(i, row, sessions.get(i, []))
                for i, row in enumerate(stored.trials)
            ],
            **stored.model_dump(include={"next_index", "node", "start_at_contact", "stop_after_s"}),
            text=format_trials(stored.trials),
            next_name=self._next_name,
            last_index=row_by_take.get(stored.take or ""),
            is_armed=self._is_armed,
            take=stored.take if running else None,
            running_name=running[0].name if running else None,
            stop_at_t_ns=stored.stop_at_t_ns if running else None,
            problem=self._problem,
        )

    def is_in_list(self, session: Session) -> bool:
        """Return whether a session is a trial of the list, or the latest trial."""
        takes = (self._list.take, *(take for row in self._list.trials for take in row.takes))
        return session.take is not None and session.take in takes

    def _make_trial_view(self, i: int, row: _StoredTrial, sessions: list[Session]) -> TrialView:
        states = {session.state for session in sessions}
        ledgers = [self._recorder.compute_ledger(session) for session in sessions]
        state: TrialState
        if not sessions:
            state = "skipped" if i < self._list.next_index else "open"
        elif "recording" in states:
            state = "recording"
        elif states != {"sealed"}:
            state = "pending"
        else:
            whole = all(ledger.completeness is True for ledger in ledgers)
            state = "complete" if whole else "lossy"
        return TrialView(
            **row.model_dump(exclude={"takes"}),
            state=state,
            recordings=len(row.takes),
            sessions=[session.id for session in sessions],
            not_sampled_share=max((each.not_sampled_share for each in ledgers), default=0.0),
        )

    @property
    def _next_name(self) -> str | None:
        if self._list.next_index >= len(self._list.trials):
            return None
        row = self._list.trials[self._list.next_index]
        suffix = f" ({len(row.takes) + 1})" if row.takes else ""
        return row.name[: _NAME_LENGTH_MAX - len(suffix)] + suffix

    def _list_running(self) -> list[Session]:
        return [
            one
            for one in self._store.list_unsealed()
            if one.state == "recording" and one.take and one.take == self._list.take
        ]

    def _check_can_record(self) -> None:
        if running := self._list_running():
            raise StateError(f"“{running[0].name}” is being recorded", remedy="Stop it first")
        if self._next_name is None:
            raise StateError(
                "no trial is left in the list", remedy="Repeat one, or set another list"
            )

    def _start(self, pre_roll_s: float, request: IdempotencyRecord | None) -> None:
        stored = self._list
        row = stored.trials[stored.next_index]
        take: Take = self._takes.start_take_where_possible(
            str(self._next_name),
            None if stored.node is None else [stored.node],
            pre_roll_s=pre_roll_s,
            subject=row.subject,
            notes=row.notes,
            tags=row.tags,
            request=request,
        )
        self._is_armed = False
        failed = [f"{node} is not recorded: {why}" for node, why in take.errors_by_node.items()]
        self._problem = ". ".join(failed) or None
        self._note_take(take.id, server_utc_ns())
        self._on_change(take.sessions)

    def _note_take(self, take: str, started_t_ns: int) -> None:
        stored, place = self._list, self._list.next_index
        rows = list(stored.trials)
        rows[place] = rows[place].model_copy(update={"takes": (*rows[place].takes, take)})
        left = (i for i in range(place + 1, len(rows)) if not rows[i].takes)
        changes = {
            "trials": tuple(rows),
            "next_index": next(left, len(rows)),
            "take": take,
            "stop_at_t_ns": stored.stop_after_s and started_t_ns + round(stored.stop_after_s * 1e9),
        }
        try:
            self._save(**changes)
        except StorageError as error:  # the trial is being recorded, whatever the file says
            self._list = stored.model_copy(update=changes)
            self._problem = f"the list of trials is not saved: {error}"

    def _disarm(self, why: str) -> None:
        self._is_armed = False
        self._problem = f"Does not wait for contact any longer: {why}"
        log.warning("%s", self._problem)
        self._on_change(())

    def _save(self, **changes: object) -> None:
        changed = self._list.model_copy(update=changes)
        write_document(self._path, changed)
        self._list = changed
