"""A walk to look at on a session's page, and what is read off the page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow.parquet as pq
from playwright.sync_api import Page, expect

from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.web.pages import box_of
from tests.web.scripted import Scripted

LOST = 40
LABEL = "a <b>stone</b>"


def recorded_walk(server: Running) -> Recording:
    """Six stances of 80 N, one frame of 90 N, a saturated tile, and forty frames that are lost."""
    node = FakeNode(server)
    node.connect()
    node.tared()
    session = node.record(name="walk", subject="leg 2", tags=["wet"], notes="slow")
    for _ in range(6):
        node.send(200, [0.0, 0.0], alive=True)
        node.send(200, [20.0, 60.0], alive=True)
    node.send(11, [20.0, 60.0], alive=True)  # the next frame is not the first of a bin
    node.send(1, [20.0, 70.0])
    node.send(200, [0.0, 0.0], alive=True)
    node.send(50, [20.0, 200.0], alive=True)
    node.send(200, [0.0, 0.0], alive=True)
    first = node.seq
    node.frames(LOST)
    node.say_lost(evicted=[[first, first + LOST - 1]])
    node.deliver(200, [0.0, 0.0], alive=True)
    node.finish(session)
    t_ns = int(session.column("t_ns")[700])
    answer = server.http.post(f"{session.url}/markers", json={"label": LABEL, "t_ns": t_ns})
    assert answer.status_code == 201
    node.close()
    return session


def url_of(session: Recording, query: str = "") -> str:
    return f"{session.running.url}/sessions/{session.id}{query}"


def settled(page: Page) -> Any:
    """The plots, once all bins of the view have come."""
    plots = page.locator("#plots[data-settled=true]")
    expect(plots).to_have_count(1)
    return plots


def seen(page: Page) -> tuple[float, float]:
    plots = settled(page)
    return float(plots.get_attribute("data-from")), float(plots.get_attribute("data-to"))


def summary(page: Page, name: str) -> float:
    return float(page.locator("#summary").get_attribute(f"data-{name}") or "nan")


def grf(session: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Seconds after the first frame, and the GRF, by the sealed file alone."""
    table = pq.read_table(session.folder / "frames.parquet", columns=["t_ns", "grf_n"])
    t_ns = table["t_ns"].to_numpy()
    return (t_ns - t_ns[0]) * 1e-9, table["grf_n"].to_numpy().astype(float)


def with_marker(scripted: Scripted) -> Recording:
    """A sealed session with a marker in its middle."""
    session = scripted.recorded("walk")
    t_ns = session.column("t_ns")
    clock = session.clock()["streams"][0]["stretches"][0]
    middle = int(t_ns[len(t_ns) // 2]) + clock["offset_ns"]
    answer = session.running.http.post(
        f"{session.url}/markers", json={"label": "a stone", "t_ns": middle}
    )
    assert answer.status_code == 201
    return session


def left_px(page: Page) -> float:
    """Where plots begin."""
    px: float = page.locator("#plots").evaluate("(plots) => plots.clientWidth < 600 ? 40 : 56")
    return px


def drag_in_plots(page: Page, from_px: float, to_px: float) -> None:
    """Drag at the height of markers' flags."""
    page.locator("#plots").evaluate("(plots) => plots.scrollIntoView()")
    box = box_of(page.locator("#plots"))
    page.mouse.move(box["x"] + from_px, box["y"] + 8)
    page.mouse.down()
    page.mouse.move(box["x"] + to_px, box["y"] + 8, steps=3)
    page.mouse.up()
