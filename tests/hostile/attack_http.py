"""Requests that the API's own description allows, and those that it does not allow.

With `--soak` every operation is played, with right and with wrong data. Small, there is time for a
few of these kinds; the next ones follow in the next turn (`FOOTTILE_TURN`, which CI counts).
"""

from __future__ import annotations

import httpx

from tests.hostile.attack import Outcome, Play, attack
from tests.hostile.stage import Served
from tests.waiting import until

TOKEN = "hostile-token"  # noqa: S105  # of this test


@attack(
    "requests drawn from the API's description, `serve`", tries=8, soak_tries=12_000, is_alone=False
)
def of_serve(play: Play) -> Outcome:
    """Operations of a server on loopback, with drawn parameters and bodies, right and wrong.

    A try is one request. It fails if the answer is 5xx (but 507), has a status that the description
    does not name, or is not of the type and schema described; or if the log speaks of a bug.
    """
    with Served(play.folder) as served:
        from tests.hostile.drawn import play_drawn

        return play_drawn(served, play)


@attack("the same with a token, given or not", tries=4, soak_tries=12_000, is_alone=False)
def of_serve_with_token(play: Play) -> Outcome:
    """As for `serve`; half of the requests have the token, the others may change nothing.

    It fails as well if a change without the token is answered by anything but a refusal.
    """
    with Served(play.folder, "serve", FOOTTILE_TOKEN=TOKEN) as served:
        from tests.hostile.drawn import play_drawn

        return play_drawn(served, play, token=TOKEN)


@attack("the same, `demo` while its node records", tries=4, soak_tries=4_000, is_alone=False)
def of_demo(play: Play) -> Outcome:
    """As for `serve`, where there are a node, tares and sessions: one is begun before.

    Fewer than there, since its node and its estimates take most of the machine.
    """
    with Served(play.folder, "demo") as served:
        nodes = f"{served.url}/api/v1/nodes"
        until(lambda: any(each["tare"] for each in httpx.get(nodes).json()["items"]), 90.0)
        served.record("demo")
        from tests.hostile.drawn import play_drawn

        return play_drawn(served, play)
