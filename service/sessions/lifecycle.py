"""Lifecycle of a session: one function from a state and an event to the next state.

recording -- `Stop` --> pending -- all frames are here --> sealing -- `Sealed` --> sealed

| event | recording | pending | sealing | sealed |
|---|---|---|---|---|
| `Reevaluate` | follows streams, or ends | sealing, or pending | sealing, or pending | same |
| `Stop` | pending | same | same | same |
| `Resume` | recording | refused | recording | refused |
| `Abandon` | refused | sealing, or pending | refused | refused |
| `Sealed` | refused | refused | sealed | refused |
| `Edit` | same | same | same | same |
| `Delete` | refused | same | same | same |

Arriving or lost frames, restarts and crashes are no events of their own: the needs of a session
follow from the present facts of its node (`NodeFacts`), so the next `Reevaluate` makes up for a
missed one. The caller saves the sessions of a `Step`, then does its action. Server, node alone and
recovery call the same function; it reads clock and journals, and writes nothing.

The trash is a folder, no state. A session whose `session.json` is damaged has no state: it is
rebuilt from its sealed file, or left out (`service.sessions.sealing`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

from devices.clock import server_utc_ns
from devices.errors import StateError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.sessions.parts import (
    NodeFacts,
    close_at_likely_end,
    close_at_stream_end_or_newest_frame,
    close_part,
    close_unfinished,
    close_where_stream_passed_stop,
    find_begin_t_ns,
    find_later_streams,
    find_usable_warm_up,
    has_begun_before_stop,
    reopen_earlier_part,
)
from storage.intervals import Intervals
from storage.sessions.folder import Ledger, Part, Session, make_session_id
from storage.sessions.ledger import (
    compute_ledger,
    group_numbers_by_stream,
    mark_damaged_and_abandoned_lost,
)


@dataclass(frozen=True)
class Reevaluate:
    """New look at the node's facts: every caller may send it at any time."""


@dataclass(frozen=True)
class Stop:
    """Stop by a person, now."""


@dataclass(frozen=True)
class Resume:
    """Continuation of an interrupted recording, by a node alone that was started again."""


@dataclass(frozen=True)
class Abandon:
    """Decision of a person that the missing frames will not come."""


@dataclass(frozen=True)
class Sealed:
    """End of sealing: the files are on the disk.

    Attributes:
        session: result of `write_sealed_files`.
    """

    session: Session


@dataclass(frozen=True)
class Edit:
    """Change by a person: name, subject, notes, tags, markers.

    Attributes:
        changes: new values by name.
    """

    changes: Mapping[str, object]


@dataclass(frozen=True)
class Delete:
    """Move to the trash."""


Event = Reevaluate | Stop | Resume | Abandon | Sealed | Edit | Delete

_EDITABLE = ("name", "subject", "notes", "tags", "markers")


@dataclass(frozen=True)
class Step:
    """Result of an event.

    Attributes:
        session: the session then.
        continuations: new sessions that continue it with other tiles, oldest first.
        is_changed: True: the session has to be saved, after its continuations.
        action: further work of the caller.
    """

    session: Session
    continuations: tuple[Session, ...] = ()
    is_changed: bool = False
    action: Literal["seal", "write_markers"] | None = None

    @property
    def sessions_to_save(self) -> tuple[Session, ...]:
        """Sessions to save, in this order: if the program is killed between, none is lost."""
        return (*reversed(self.continuations), self.session) if self.is_changed else ()


_NO_FACTS = NodeFacts()


def create_session(
    info: ArrayInfo,
    name: str,
    part: Part,
    *,
    scene_content: Mapping[str, Any],
    calibration: Calibration | None,
    **fields: Any,
) -> Session:
    """Create a session that begins now.

    Args:
        info: array of its first part.
        name: user-given name.
        part: first part.
        scene_content: content of the node's scene file.
        calibration: calibration in use at the beginning.
        fields: further fields of a session, or other values of the above.
    """
    facts: dict[str, Any] = {
        "id": make_session_id(datetime.now(UTC)),
        "name": name,
        "node": info.node,
        "state": "recording",
        "started_t_ns": server_utc_ns(),
        "parts": (part,),
        "scene": info.scene,
        "scene_content": dict(scene_content),
        "calibration": calibration.model_dump(mode="json") if calibration is not None else None,
    }
    return Session(**facts | fields)


def apply_event(session: Session, event: Event, node: NodeFacts = _NO_FACTS) -> Step:
    """Return the step of a session at an event; the table is above.

    Args:
        session: the session.
        event: the event.
        node: present facts of its node; only `Reevaluate`, `Stop` and `Abandon` need them.

    Raises:
        StateError: the session's state refuses the event.
        ValueError: an `Edit` of a field that people do not change.
        DamagedFramesError: the frames at its end are damaged; nothing has changed.
    """
    match session.state, event:
        case _, Edit(changes):
            if unknown := changes.keys() - set(_EDITABLE):
                raise ValueError(f"people do not change {', '.join(sorted(unknown))}")
            edited = session.model_copy(update=dict(changes))
            has_file = session.state == "sealed" and "markers" in changes
            action: Literal["write_markers"] | None = "write_markers" if has_file else None
            return Step(edited, is_changed=edited != session, action=action)
        case "recording", Stop():
            return Step(_stop(session, node), is_changed=True)
        case "recording" | "sealing", Resume():
            return Step(_resume(session), is_changed=True)
        case "pending", Abandon():
            return _update_parts_and_state(session, replace(node, frames_to_come="abandoned"))
        case "sealing", Sealed(sealed):
            # A person may have edited the session during sealing.
            user_fields = {name: getattr(session, name) for name in _EDITABLE}
            edges = (marker for marker in sealed.markers if marker.stream_id is not None)
            user_fields["markers"] = session.with_replaced_edges(edges).markers
            has_other_markers = user_fields["markers"] != sealed.markers
            return Step(
                sealed.model_copy(update=user_fields),
                is_changed=True,
                action="write_markers" if has_other_markers else None,
            )
        case "recording" | "pending" | "sealing", Reevaluate():
            return _update_parts_and_state(session, node)
        case ("sealed", Reevaluate()) | (_, Stop()) | ("pending" | "sealing" | "sealed", Delete()):
            return Step(session)
    raise _make_refusal(session, event)


def _make_refusal(session: Session, event: Event) -> StateError:
    first_stop = "Stop it first" if session.state == "recording" else ""
    match event:
        case Delete():
            return StateError(f"session {session.id} is being recorded", remedy=first_stop)
        case Abandon():
            expected, remedy = "a session that is pending", first_stop
        case Sealed():
            expected, remedy = "a session that is sealing", ""
        case _:
            expected, remedy = "a session that is being recorded", ""
    return StateError(f"session {session.id} is {session.state}", expected=expected, remedy=remedy)


def _stop(session: Session, node: NodeFacts) -> Session:
    """Return the session, stopped now; its end is open until the stream has passed this time."""
    update: dict[str, object] = {
        "stopped_t_ns": node.now_t_ns,
        "state": "pending",
        "problem": None,
        "vitals_at_stop": node.vitals,
    }
    if node.present_id is not None and node.offset_ns is not None:
        update["server_minus_node_ns_at_stop"] = {node.present_id: node.offset_ns}
    present = node.find_stream(node.present_id) if node.present_id is not None else None
    if present is None or not node.is_connected:
        return session.model_copy(update=update)
    update["missed_slots_at_stop"] = {node.present_id: present.missed_slots}
    session = session.model_copy(update=update)
    if node.offset_ns is not None or node.newest_seq is None:
        return session
    # Its clock cannot be compared with ours: end with the newest frame.
    return close_part(session, session.parts[-1], node.newest_seq)


def _resume(session: Session) -> Session:
    """Return an interrupted session as it was while it was recorded."""
    *before, last_part = session.parts
    part = last_part.model_copy(update={"seq_last": None})
    update = {"state": "recording", "stopped_t_ns": None, "parts": (*before, part)}
    return session.model_copy(update=update)


def _update_parts_and_state(before: Session, node: NodeFacts) -> Step:
    """Extend or close the parts, and set the state that follows: pending, sealing, or the same."""
    session, continuations = before, []
    is_recorded = before.state == "recording" and node.frames_to_come == "possible"
    if node.frames_to_come != "possible":
        session, *continuations = _end_without_missing(session, node)
    elif session.state != "sealing":
        session, *continuations = _follow_streams(session, node)
    if not is_recorded:  # a recording that other tiles end is pending; the next event seals it
        state = "sealing" if is_ready_to_seal(session, node) else "pending"
        if state != session.state:
            session = session.model_copy(update={"state": state})
    return Step(
        session,
        tuple(continuations),
        is_changed=session is not before and session != before,
        action="seal" if session.state == "sealing" else None,
    )


def _end_without_missing(session: Session, node: NodeFacts) -> list[Session]:
    """Return the session with every part closed: no more frames will come, or count.

    Further sessions of the result continue it with other tiles.
    """
    found, is_abandoned = [session], node.frames_to_come == "abandoned"
    if is_abandoned and has_unreadable_journal(session, node):
        # Frames in an unreadable journal are abandoned; later streams have their own journals.
        found = _follow_streams(session.model_copy(update={"is_abandoned": True}), node)
    closed = close_unfinished(reopen_earlier_part(found[0], node), node)
    update = {"state": "pending", "is_abandoned": is_abandoned}
    return [closed.model_copy(update=update), *found[1:]]


def _follow_streams(session: Session, node: NodeFacts) -> list[Session]:
    """Extend the session's parts to the present end of its node's streams.

    Returns:
        The session, and further ones that continue it where the node came back with other tiles.
    """
    found = [reopen_earlier_part(session, node)]
    while found[-1].parts[-1].seq_last is None:
        extended = _follow_once(found[-1], node)
        if not extended:
            break
        found[-1:] = extended
    return found


def _follow_once(session: Session, node: NodeFacts) -> list[Session]:
    """Close the open part and return the session with the next one; empty if undecided."""
    stream_id = session.parts[-1].stream_id
    if stream_id in node.unreadable and not session.is_abandoned:
        return []
    closed = close_where_stream_passed_stop(session, node, leave_open_while_missing=True)
    if closed.parts[-1].seq_last is not None:
        return [closed]
    if stream_id == node.present_id or not node.has_reported:
        return []
    following = next(iter(find_later_streams(session, node)), None)
    if following is None:
        return []
    has_begun = has_begun_before_stop(session, node, following)
    if has_begun is None:
        return []
    closed = close_at_stream_end_or_newest_frame(session, node)
    stream, next_stream = (node.get_stream(session, name) for name in (stream_id, following))
    if not has_begun:
        wanted = group_numbers_by_stream(closed.parts).get(stream_id, Intervals())
        return [] if (stream.obtainable - stream.stored) & wanted else [closed]
    infos = stream.info, next_stream.info
    if infos[0] is None or infos[1] is None or infos[0].has_same_tiles_as(infos[1]):
        part = Part(stream_id=following, seq_first=0)
        return [closed.model_copy(update={"parts": (*closed.parts, part)})]
    return _continue_with_other_tiles(closed, infos[1], find_begin_t_ns(next_stream, node), node)


def _continue_with_other_tiles(
    session: Session, info: ArrayInfo, begin_t_ns: int, node: NodeFacts
) -> list[Session]:
    """Return a session whose tiles have changed, ended, and its continuation.

    A file describes one array, so the recording goes on in another session.

    Args:
        session: session whose last part is closed.
        info: present array of the node.
        begin_t_ns: begin of its stream, by the clock that gives the times of stops.
        node: facts of the node.
    """
    update: dict[str, object] = {"problem": "the node came back with other tiles: recording ended"}
    if session.state == "recording":
        update |= {"state": "pending", "stopped_t_ns": begin_t_ns}
    name, number = split_number_in_parentheses(session.name)
    continuation = create_session(
        info,
        f"{name} ({number + 1})",
        Part(stream_id=info.stream_id, seq_first=0),
        scene_content=node.scene_content if info.scene == node.scene else {},
        calibration=node.calibration,
        calibration_source=node.calibration_source,
        state=session.state,
        started_t_ns=begin_t_ns,
        stopped_t_ns=session.stopped_t_ns,
        continues=session.id,
        **{field: getattr(session, field) for field in ("subject", "notes", "tags", "take")},
    )
    return [session.model_copy(update=update), continuation]


class NumberedName(NamedTuple):
    """Name of a session as given, and its number: 2 for `mud (2)`, else 1."""

    given: str
    number: int


def split_number_in_parentheses(name: str) -> NumberedName:
    """Split a session's name into the given name and its number."""
    match = re.fullmatch(r"(.*) \((\d+)\)", name)
    return NumberedName(match[1], int(match[2])) if match else NumberedName(name, 1)


def is_ready_to_seal(session: Session, node: NodeFacts) -> bool:
    """Return whether the end is found, and all obtainable frames are stored and synced."""
    if session.parts[-1].seq_last is None or has_unreadable_journal(session, node):
        return False
    needed = group_numbers_by_stream(session.parts)
    streams = node.collect_streams(session)
    if any(stream.unsynced & needed.get(name, Intervals()) for name, stream in streams.items()):
        return False
    return not compute_present_ledger(session, node).pending


def has_unreadable_journal(session: Session, node: NodeFacts) -> bool:
    """Return whether a journal of the session cannot be read now: its losses are then unknown."""
    if session.is_abandoned:
        return False
    return any(part.stream_id in node.unreadable for part in session.parts)


def compute_present_ledger(session: Session, node: NodeFacts) -> Ledger:
    """Return the session's present ledger: the fate of every frame."""
    if session.state == "sealed" and session.ledger is not None:
        return session.ledger
    is_finished = session.stopped_t_ns is not None and session.parts[-1].seq_last is not None
    likely = close_at_likely_end(session, node)
    states = mark_damaged_and_abandoned_lost(likely, node.collect_streams(likely))
    return compute_ledger(likely.parts, states, has_all_parts=is_finished)


def iterate_needed_parts(session: Session, node: NodeFacts) -> Iterator[Part]:
    """Yield the parts that an unsealed session needs in the journals, possible later ones too.

    Its warm-up frames are among them: they are kept, and sent again, but not waited for.
    """
    if (warm_up := find_usable_warm_up(session)) is not None:
        yield warm_up
    yield from session.parts
    if session.parts[-1].seq_last is None:
        # The stream in which the session was stopped is not known yet.
        for stream_id in find_later_streams(session, node):
            yield Part(stream_id=stream_id, seq_first=0)
