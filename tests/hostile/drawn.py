"""Requests drawn by schemathesis from the description that a server gives of itself, and judged."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Any

import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import Case, GenerationMode
from schemathesis.checks import CheckFunction, not_a_server_error
from schemathesis.core.failures import FailureGroup
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.api.access import LOGIN_PATH, SAFE_METHODS
from tests.hostile.attack import Outcome, Play
from tests.hostile.stage import Served, traces

_REFUSED = (HTTPStatus.BAD_REQUEST, HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN, 413)
_AT_ONCE = 8
"""Requests of one kind, if there are tries enough; to begin with a kind costs as much as these."""
AnyCase = Case[Any]
CHECKS: list[CheckFunction] = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]


def play_drawn(served: Served, play: Play, *, token: str | None = None) -> Outcome:
    """Requests of every kind, an operation and right or wrong data for it; of few tries, each of
    another kind, and those of the next turn of the kinds that follow.

    Args:
        served: the server.
        play: how many, and from which draw.
        token: half of the requests have this token and the others none; None: all have the one
            that tests share.
    """
    schema = schemathesis.openapi.from_url(served.url + "/api/v1/openapi.json")
    operations = [result.ok() for result in schema.get_all_operations() if isinstance(result, Ok)]
    outcome = Outcome()
    outcome.figures["operations"] = str(len(operations))
    modes = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
    kinds = [(operation, mode) for operation in operations for mode in modes]
    play.random.shuffle(kinds)
    first = play.turn * play.tries % len(kinds)
    at_once = min(_AT_ONCE, max(1, play.tries // len(kinds)))
    with requests.Session() as session:
        session.trust_env = False
        ask = partial(_ask, served, session, token, outcome)
        while outcome.tries < play.tries:
            for operation, mode in kinds[first:] + kinds[:first]:
                n = min(at_once, play.tries - outcome.tries)
                if n > 0:
                    _play(operation, mode, n, play.random.randrange(2**32), ask)
    outcome.failures += [f"the log: {line}" for line in traces(served)[:5]]
    if served.http.get("/ready").status_code != HTTPStatus.OK:
        outcome.failures.append("the server is not ready any more")
    return outcome


def _play(
    operation: Any, mode: GenerationMode, n: int, drawn: int, ask: Callable[[AnyCase], None]
) -> None:
    @seed(drawn)
    @settings(
        max_examples=n,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(mode))
    def run(case: AnyCase) -> None:
        ask(case)

    with suppress(Unsatisfiable):
        run()


def _ask(
    served: Served, session: requests.Session, token: str | None, outcome: Outcome, case: AnyCase
) -> None:
    """Ask, of things that are there as often as of those that are not, and judge the answer."""
    ids = _ids_of(served)
    named = case.path_parameters or {}
    chosen = {name: ids[name] for name in named if name in ids and outcome.tries % 2}
    case.path_parameters = {**named, **chosen}
    headers = dict(served.shown)
    if token and outcome.tries % 4 < 2:
        headers = {"Authorization": f"Bearer {token}"}
    answer = case.call(session=session, headers=headers, timeout=20)
    command = case.as_curl_command()
    try:
        case.validate_response(answer, checks=CHECKS)
    except FailureGroup as found:
        outcome.failed(f"{command}: {answer.status_code}: {found.exceptions[0]}"[:2000])
        return
    # Who has no login may try to get one, and log out.
    is_change = case.method.upper() not in SAFE_METHODS and case.path != LOGIN_PATH
    if token and is_change and not headers and answer.status_code not in _REFUSED:
        outcome.failed(f"{command}: {answer.status_code} without the token")
        return
    outcome.saw(str(answer.status_code))


def _ids_of(served: Served) -> dict[str, str]:
    sessions = served.sessions()
    nodes = served.http.get("/nodes").json()["items"]
    found = {"session_id": sessions[-1]["id"]} if sessions else {}
    return found | ({"node": nodes[0]["node"]} if nodes else {})
