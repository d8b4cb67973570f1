"""Routes of the list of trials."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Body
from pydantic import Field

from devices.types import StrictModel
from service.api.routes.common import (
    FULL,
    IdempotencyKey,
    ServerState,
    make_idempotency_record,
    problem_responses,
)
from service.protocol.live import TrialsView
from service.server.trials import STOP_AFTER_S_MAX, TRIALS_MAX, ListedTrial, parse_trials

router = APIRouter(prefix="/trials", tags=["trials"])


class TrialList(StrictModel):
    """List of trials."""

    trials: Annotated[tuple[ListedTrial, ...], Field(max_length=TRIALS_MAX)]


class ChangeTrials(StrictModel):
    """Changes of place and settings; omitted fields are unchanged."""

    next_index: Annotated[int, Field(ge=0, le=TRIALS_MAX, strict=True)] = Field(
        default=0, description="Row that is recorded next, from 0: skips or repeats rows."
    )
    node: str | None = Field(default=None, description="Node to record; null: all connected ones.")
    start_at_contact: bool = Field(
        default=False, description="True: the next trial begins when a contact begins."
    )
    stop_after_s: Annotated[float, Field(ge=1, le=STOP_AFTER_S_MAX)] | None = Field(
        default=None, description="Time after which a trial is stopped; null: by a person."
    )
    is_armed: Literal[False] = Field(
        default=False, description="false: do not wait for a contact any longer."
    )


class RecordTrial(StrictModel):
    """Request to record the next trial."""


@router.get("", summary="List of trials")
async def get_trials(server: ServerState) -> TrialsView:
    """Return the list, its place, and the state of each trial."""
    return server.trials.make_view()


@router.put("", summary="Set the list of trials", responses=problem_responses(FULL))
async def set_trials(
    server: ServerState,
    body: Annotated[
        TrialList | str,
        Body(
            description="As text, a trial a line: `name; tag, tag`, or names with commas between."
        ),
    ] = "",
) -> TrialsView:
    """Replace the list and keep the place; rows of equal names keep recordings and omitted fields.

    No text clears the list.
    """
    server.trials.set_trials(parse_trials(body) if isinstance(body, str) else body.trials)
    return server.trials.make_view()


@router.patch(
    "", summary="Skip, repeat, set up", responses=problem_responses(FULL, _404="No such node.")
)
async def change_trials(body: ChangeTrials, server: ServerState) -> TrialsView:
    """Choose the next row, change settings, or stop waiting for a contact."""
    server.trials.change(body.model_dump(exclude_unset=True))
    return server.trials.make_view()


@router.post(
    "/record",
    summary="Record the next trial",
    responses=problem_responses(
        FULL, _409="No row is left, a trial is being recorded, or no node can be recorded."
    ),
)
async def record_trial(
    body: RecordTrial, server: ServerState, idempotency_key: IdempotencyKey = None
) -> TrialsView:
    """Record a take with the next row's name and tags, or wait for a contact to do so.

    The place advances only once it is recorded. A repeated request with the same key starts
    nothing.
    """
    server.trials.record_next(make_idempotency_record(idempotency_key, "trial", body))
    return server.trials.make_view()
