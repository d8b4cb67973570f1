"""Routes of a session's videos: upload, download, times of pictures, alignment."""

from __future__ import annotations

from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import contextmanager_in_threadpool, run_in_threadpool
from pydantic import BaseModel, Field
from starlette.requests import ClientDisconnect

from devices.errors import FileFormatError, StateError, UsageError
from devices.types import StrictModel, TNs
from service.api.routes.common import (
    FULL,
    JSON,
    NO_CONTENT,
    UNCHANGED,
    ServerState,
    problem_responses,
    require_file,
    require_frames,
    require_sealed,
    run_with_usage_errors,
    stored_file_response,
)
from service.server.server import Server
from service.user_folders import PublicText
from service.video import methods
from service.video.alignment import fit_alignment
from service.video.methods import AlignmentOptions, compute_common_ns, store_alignment
from service.video.worker import check_extra_installed, describe_film
from storage.sessions.folder import Session
from storage.sessions.videos import (
    FILM_MEDIA_TYPES,
    TIMES_NAME,
    IncomingVideo,
    Video,
    find_video_folder,
    get_film_path,
    read_video,
    read_videos,
    remove_video,
    write_video,
)

router = APIRouter(prefix="/sessions/{session_id}/videos", tags=["videos"])

_DESCRIBING = CapacityLimiter(1)
"""One thread: an upload waits for no search."""
_DECODING = CapacityLimiter(1)
"""One thread: each waits for a process that decodes a film."""
_WRITING = CapacityLimiter(1)
"""One thread: uploads share the disk with journals."""
_CHUNK_BYTES = 4 << 20
_PAIRS_MAX = 200
_SECONDS_MAX = 1e6

_CONTRADICTS = "Its description is damaged, or it contradicts the alignment by another method."
_Replace = Annotated[bool, Query(description="Replace an alignment that it contradicts.")]
_UNKNOWN = problem_responses(_404="No such session or video.", _409="Its description is damaged.")


class VideosView(BaseModel):
    """Videos of a session."""

    items: list[Video]
    problems: list[PublicText] = Field(description="Damaged videos, which are not in the list.")


class TimesView(BaseModel):
    """Times of a film's pictures."""

    film_s: list[float] = Field(description="Of all pictures, in s from the first one.")
    whole_s: list[float] | None = Field(
        default=None,
        description="Of the same pictures as the file plays with those that its edit list hides, "
        "in s from the file's first one; none: it hides none, or cannot be replaced.",
    )


class PairOfInstants(StrictModel):
    """Instant of a film and the same one in its session."""

    film_s: Annotated[float, Field(ge=-_SECONDS_MAX, le=_SECONDS_MAX)] = Field(
        description="In s from the first picture."
    )
    t_ns: TNs = Field(description="Session's time.")
    sigma_ns: Annotated[float, Field(ge=1.0, le=1e12)] = Field(
        description="Standard deviation of their difference."
    )


class AlignVideo(StrictModel):
    """Pairs of instants that a person or a program has found."""

    method: Literal["hand", "contact"]
    pairs: Annotated[tuple[PairOfInstants, ...], Field(min_length=1, max_length=_PAIRS_MAX)]


@router.get("", summary="Videos", responses=problem_responses(_404="No such session."))
async def list_videos(session_id: str, server: ServerState) -> VideosView:
    """Return the session's videos, oldest first."""
    videos, problems = await run_in_threadpool(read_videos, _find_folder(session_id, server))
    return VideosView(items=videos, problems=problems)


@router.post(
    "",
    summary="Add a video",
    status_code=HTTPStatus.CREATED,
    responses=problem_responses(
        FULL,
        _404="No such session.",
        _409="The session is not sealed.",
        _413="It is longer than 64 GiB.",
        _422="It is no film, or broken; or the extra `video` is not installed.",
        _507="The disk is full but for a reserve for frames.",
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The file as it is.",
            "content": {"application/octet-stream": {"schema": {"type": "string"}}},
        }
    },
)
async def add_video(
    session_id: str,
    name: Annotated[str, Query(max_length=255, description="Name of the file, with its suffix.")],
    request: Request,
    server: ServerState,
    response: Response,
    capture_rate_hz: Annotated[
        float | None,
        Query(
            ge=1e-3,
            le=1e6,
            description="Pictures per second when it was taken, if it plays at another rate.",
        ),
    ] = None,
) -> Video:
    """Keep a film beside a sealed session, once its time stamps and pictures can be read."""
    check_extra_installed()
    _require_sealed_with_frames(session_id, server)
    folder = _find_folder(session_id, server)
    size_bytes = int(request.headers.get("content-length", 0))
    incoming = run_with_usage_errors(partial(IncomingVideo, folder, name, size_bytes))
    describe = partial(describe_film, name=incoming.name, capture_rate_hz=capture_rate_hz)
    keep = partial(run_with_usage_errors, partial(incoming.keep, describe))
    try:
        async with contextmanager_in_threadpool(incoming):
            await _receive(request, incoming)
            video = await to_thread.run_sync(keep, limiter=_DESCRIBING)
    except ClientDisconnect as error:
        raise UsageError("the upload broke off, and nothing is kept") from error
    response.headers["Location"] = f"/api/v1/sessions/{session_id}/videos/{video.id}"
    return video


async def _receive(request: Request, incoming: IncomingVideo) -> None:
    """Write a request's body in bounded chunks, in a thread; the client waits for the disk."""
    parts: list[bytes] = []
    async for part in request.stream():
        parts.append(part)
        if not part or sum(map(len, parts)) >= _CHUNK_BYTES:
            await to_thread.run_sync(incoming.write, *parts, limiter=_WRITING)
            parts = []


@router.get("/{video_id}", summary="A video", responses=_UNKNOWN)
async def get_video(session_id: str, video_id: str, server: ServerState) -> Video:
    """Return facts of a film, and its alignment; null: its time is not known."""
    return (await run_in_threadpool(_read, session_id, video_id, server))[1]


@router.delete(
    "/{video_id}", summary="Delete a video", **NO_CONTENT, responses=problem_responses(_UNKNOWN)
)
async def delete_video(session_id: str, video_id: str, server: ServerState) -> None:
    """Delete a video for good, with its alignment and the files made from it."""
    await run_in_threadpool(remove_video, _find_folder(session_id, server), video_id)


@router.get(
    "/{video_id}/film",
    summary="Download a film",
    response_class=Response,
    responses=problem_responses(
        {
            200: {
                "description": "The file as it came.",
                "content": {kind: {} for kind in dict.fromkeys(FILM_MEDIA_TYPES.values())},
            },
            206: {"description": "A range of it."},
        },
        UNCHANGED,
        _UNKNOWN,
        _416="The range is outside the file.",
    ),
)
async def get_film(
    session_id: str,
    video_id: str,
    request: Request,
    server: ServerState,
    whole: Annotated[
        bool,
        Query(
            description="With the pictures that its edit list hides: browsers differ in which "
            "these are, and so need the times `whole_s`."
        ),
    ] = False,
) -> Response:
    """Return the file, with ranges."""
    folder, video = await run_in_threadpool(_read, session_id, video_id, server)
    patch = video.film.patch if whole else None
    return stored_file_response(
        request,
        require_file(get_film_path(folder, video)),
        video.sha256,
        media_type=FILM_MEDIA_TYPES.get(video.suffix, "application/octet-stream"),
        filename=video.name,
        patch=None if patch is None else (patch.at, bytes.fromhex(patch.hex)),
    )


@router.get(
    "/{video_id}/times",
    summary="Times of a film's pictures",
    response_model=TimesView,
    responses=problem_responses(UNCHANGED, _UNKNOWN),
)
async def get_film_times(
    session_id: str, video_id: str, request: Request, server: ServerState
) -> Response:
    """Return the time of every picture, in order of display."""
    folder, video = await run_in_threadpool(_read, session_id, video_id, server)
    path = require_file(folder / TIMES_NAME)
    return stored_file_response(
        request, path, video.times_sha256, media_type=JSON, filename=f"{video.id}.json"
    )


@router.put(
    "/{video_id}/alignment",
    summary="Align a video by hand",
    responses=problem_responses(
        _UNKNOWN, FULL, _409=_CONTRADICTS, _422="Invalid body, or the pairs disagree."
    ),
)
async def align_video(
    session_id: str, video_id: str, body: AlignVideo, server: ServerState, replace: _Replace = False
) -> Video:
    """Fit offset and drift of the film's clock to pairs of instants."""
    session = _require_sealed_with_frames(session_id, server)
    folder, video = await run_in_threadpool(_read, session_id, video_id, server)
    begin_t_ns = session.started_t_ns
    sigma_ns = np.array([pair.sigma_ns for pair in body.pairs])
    fit = partial(
        fit_alignment,
        body.method,
        np.array([pair.film_s for pair in body.pairs]),
        np.array([float(pair.t_ns - begin_t_ns) for pair in body.pairs]),
        sigma_ns,
        begin_t_ns=begin_t_ns,
        drift_sigma=video.film.drift_sigma,
        common_ns=compute_common_ns(sigma_ns),
    )
    aligned = run_with_usage_errors(fit)
    store = partial(store_alignment, folder, aligned, replaces=replace)
    return await run_in_threadpool(run_with_usage_errors, store)


@router.post(
    "/{video_id}/alignment",
    summary="Find an alignment in the film",
    responses=problem_responses(
        _UNKNOWN, FULL, _409=_CONTRADICTS, _422="Lamp or clock page is not found in the film."
    ),
)
async def find_alignment(
    session_id: str,
    video_id: str,
    method: Annotated[
        Literal["light", "clock"],
        Query(description="The node's lamp, or the page /clock, is in the picture."),
    ],
    server: ServerState,
    near_s: Annotated[
        float | None,
        Query(
            ge=-_SECONDS_MAX,
            le=_SECONDS_MAX,
            description="About when the film begins, in s after the session, within 5 s.",
        ),
    ] = None,
    replace: _Replace = False,
) -> Video:
    """Find offset and drift by the lamp or the clock page; films are decoded one at a time."""
    _require_sealed_with_frames(session_id, server)
    await run_in_threadpool(_read, session_id, video_id, server)
    find = partial(
        methods.align_video,
        *(_find_folder(session_id, server), video_id),
        method,
        AlignmentOptions(near_s=near_s, replaces=replace),
    )
    return await to_thread.run_sync(partial(run_with_usage_errors, find), limiter=_DECODING)


@router.delete(
    "/{video_id}/alignment",
    summary="Delete an alignment",
    responses=problem_responses(_UNKNOWN, FULL),
)
async def delete_alignment(session_id: str, video_id: str, server: ServerState) -> Video:
    """Forget how the film's time and the session's belong together."""
    return await run_in_threadpool(_forget_alignment, session_id, video_id, server)


def _forget_alignment(session_id: str, video_id: str, server: Server) -> Video:
    folder, video = _read(session_id, video_id, server)
    video = video.model_copy(update={"alignment": None})
    write_video(folder, video)
    return video


def _find_folder(session_id: str, server: Server) -> Path:
    return server.sessions.folder.get_path(server.sessions.get_session(session_id).id)


def _require_sealed_with_frames(session_id: str, server: Server) -> Session:
    session = server.sessions.get_session(session_id)
    return require_frames(require_sealed(session, "videos of it are"))


def _read(session_id: str, video_id: str, server: Server) -> tuple[Path, Video]:
    """Find a video's folder and read its description."""
    folder = find_video_folder(_find_folder(session_id, server), video_id)
    try:
        return folder, read_video(folder)
    except FileFormatError as error:
        raise StateError(str(error), remedy="Remove it, or restore it from a backup") from error
