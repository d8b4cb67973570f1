"""A thousand sessions: listed as one scrolls, searched, chosen, downloaded as one file, deleted."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from storage.documents import write_checksummed_json
from storage.sessions.folder import SessionsFolder
from tests.service.fake_node import FakeNode
from tests.service.patient import be_patient
from tests.service.running import Running
from tests.web.login import log_in
from tests.web.pages import OpenPage, complaints, width_of
from tests.web.received import Received

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


MANY = 1000
SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A server of a thousand sessions: copies of one, with names and times of their own."""
    data = tmp_path_factory.mktemp("archive") / "data"
    running = Running(data)
    with pytest.MonkeyPatch.context() as patch:
        be_patient(patch)
        running.start()
        node = FakeNode(running)
        node.connect()
        node.tared()
        session = node.record(name="walk 0", subject="leg 2", tags=["wet"])
        node.deliver(300, [20.0, 60.0])
        node.finish(session)
        node.close()
        running.stop()
        original = SessionsFolder(data / "sessions").load(session.id)
        for i in range(1, MANY):
            copy = original.model_copy(
                update={
                    "id": f"20200101T000000Z-{i:06x}",
                    "name": f"{'mud' if i % 100 == 7 else 'walk'} {i}",
                    "started_t_ns": original.started_t_ns - i * SECOND_NS,
                }
            )
            folder = data / "sessions" / copy.id
            shutil.copytree(session.folder, folder, copy_function=os.link)
            (folder / "session.json").unlink()
            write_checksummed_json(folder / "session.json", copy.model_dump_json().encode())
        running.start()
        yield running
        running.stop()


LOW = (1280, 400)
"""So low that the twenty rows of a first answer reach beyond what is fetched ahead."""


TOPS = """() => [...document.querySelectorAll("#sessions .session")]
  .map((row) => row.getBoundingClientRect().top)"""


def names(page: Page) -> list[str]:
    return page.locator("#sessions .session-name").all_text_contents()


def test_a_thousand_sessions_come_as_one_scrolls_each_once_and_in_order(
    archive: Running, open_page: OpenPage
) -> None:
    page = open_page(f"{archive.url}/sessions", *LOW)
    rows = page.locator("#sessions .session")
    expect(rows).to_have_count(20)
    expect(page.locator("#sessions-more")).to_be_visible()
    while rows.count() < MANY:
        before = rows.count()
        page.locator("#sessions-more").scroll_into_view_if_needed()
        page.wait_for_function(
            f"() => document.querySelectorAll('#sessions .session').length > {before}"
        )
    expect(page.locator("#sessions-more")).to_be_hidden()
    assert names(page) == [f"{'mud' if i % 100 == 7 else 'walk'} {i}" for i in range(MANY)]
    # To be told of one more does not lay out the others: each row is the element that it was.
    page.evaluate("window.tenth = document.querySelectorAll('#sessions .session')[10]")
    ids = [s["id"] for s in archive.http.get("/sessions", params={"limit": 1}).json()["items"]]
    archive.http.patch(f"/sessions/{ids[0]}", json={"notes": "slow"})
    expect(rows.first).to_contain_text("slow")
    assert page.evaluate("document.querySelectorAll('#sessions .session')[10] === window.tenth")


def test_the_first_load_with_a_thousand_sessions_is_small(
    archive: Running, open_page: OpenPage
) -> None:
    page = open_page("about:blank", 390, 844)
    log_in(page.context, archive.url)
    received = Received(page)
    page.goto(f"{archive.url}/sessions")
    expect(page.locator("#sessions .session")).to_have_count(20)
    received.wait_for("/sessions?")
    assert sum(received.bytes_of.values()) < 120_000, received.bytes_of


def test_what_is_searched_for_is_found_by_the_server(archive: Running, open_page: OpenPage) -> None:
    page = open_page(f"{archive.url}/sessions", *LOW)
    rows = page.locator("#sessions .session")
    expect(rows).to_have_count(20)
    page.fill("#sessions-search", "MUD")
    expect(rows).to_have_count(10)
    assert names(page) == [f"mud {i}" for i in range(7, MANY, 100)]
    archive.http.patch("/sessions/20200101T000000Z-000001", json={"notes": "no stones"})
    page.fill("#sessions-search", "stones")
    expect(rows).to_have_count(1)
    page.fill("#sessions-search", "nobody")
    expect(page.locator("#sessions")).to_contain_text("No session matches “nobody”.")
    page.fill("#sessions-search", "")
    expect(rows).to_have_count(20)
    # Those with missing frames are found among all, too.
    page.select_option("#sessions-complete", label="Lossy")
    expect(page.locator("#sessions")).to_have_text("No lossy sessions.")
    page.select_option("#sessions-complete", label="Complete")
    page.fill("#sessions-search", "MUD")
    expect(rows).to_have_count(10)
    assert complaints(page) == []


def searched(page: Page) -> None:
    """Only the ten that are called mud are listed."""
    page.fill("#sessions-search", "mud")
    expect(page.locator("#sessions .session")).to_have_count(10)


def test_several_are_chosen_and_come_as_one_zip_file(
    archive: Running, open_page: OpenPage, tmp_path: Path
) -> None:
    page = open_page(f"{archive.url}/sessions", *LOW)
    searched(page)
    expect(page.locator("#chosen")).to_be_hidden()
    compare = page.locator("#chosen-compare")
    before = page.evaluate(TOPS)
    page.get_by_role("checkbox", name="Select mud 7", exact=True).check()
    expect(page.locator("#chosen-text")).to_have_text("1 selected")
    expect(page.locator("#chosen")).to_be_in_viewport()
    assert page.evaluate(TOPS) == before
    expect(compare).to_be_hidden()
    page.get_by_role("checkbox", name="Select mud 107", exact=True).check()
    expect(page.locator("#chosen-text")).to_have_text("2 selected")
    expect(compare).to_have_attribute(
        "href", "/sessions/20200101T000000Z-000007?with=20200101T000000Z-00006b"
    )
    expect(page.locator("#chosen-zip")).to_contain_text("Download 2 sessions as zip")
    assert complaints(page) == []
    with page.expect_download() as download:
        page.click("#chosen-zip")
    path = tmp_path / "some.zip"
    download.value.save_as(path)
    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
        folders = {name.split("/")[0] for name in file.namelist()}
        assert folders == {f"20200101T000000Z-{i:06x}" for i in (7, 107)}
        for name in file.namelist():
            assert file.read(name) == (archive.data / "sessions" / name).read_bytes()
    page.get_by_role("checkbox", name="Select all").check()
    expect(page.locator("#chosen-text")).to_have_text("10 selected")
    expect(compare).to_be_hidden()
    page.click("#chosen-none")
    expect(page.locator("#chosen")).to_be_hidden()


def test_several_are_deleted_and_had_back(archive: Running, open_page: OpenPage) -> None:
    page = open_page(f"{archive.url}/sessions", 390, 844)
    searched(page)
    chosen = ["mud 107", "mud 207", "mud 307"]
    for name in chosen:
        page.get_by_role("checkbox", name=f"Select {name}", exact=True).check()
    page.click("#chosen-delete")
    expect(page.locator("#ask-dialog")).to_contain_text("Move 3 sessions to the trash?")
    page.click("#ask-yes")
    expect(page.locator("#notices")).to_contain_text("3 sessions moved to the trash")
    expect(page.locator("#chosen")).to_be_hidden()
    trash = archive.http.get("/trash").json()["items"]
    assert sorted(session["name"] for session in trash) == chosen
    page.locator("#notices").get_by_role("button", name="Undo").click()
    expect(page.locator("#sessions .session")).to_have_count(10)
    assert archive.http.get("/trash").json()["items"] == []
    assert width_of(page) == 390
    assert complaints(page) == []
