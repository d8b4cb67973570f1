"""A session in the list, and the menu of its row."""

from __future__ import annotations

from playwright.sync_api import Locator, Page

from tests.service.recording import Recording


def row_of(page: Page, session: Recording) -> Locator:
    return page.locator(f'#sessions [data-session-id="{session.id}"]')


def open_menu(page: Page, row: Locator) -> Locator:
    """Its menu."""
    row.get_by_role("button", name="Actions").click()
    return page.get_by_role("menu")


def choose(page: Page, row: Locator, action: str) -> None:
    """Press what the menu of a row calls so, or begins with."""
    open_menu(page, row).get_by_role("menuitem", name=action).click()
