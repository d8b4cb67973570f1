"""What a page really costs to load."""

from __future__ import annotations

import time
from typing import Any

from playwright.sync_api import Page

from tests.waiting import PATIENCE_S


class Received:
    """Counts what comes over the wire for a page: heads and bodies, as compressed as they are."""

    def __init__(self, page: Page) -> None:
        self.bytes_of: dict[str, int] = {}
        """By address, of answers that have come whole."""
        self._page = page
        self._open: dict[str, str] = {}
        devtools = page.context.new_cdp_session(page)
        devtools.on("Network.requestWillBeSent", self._asked)
        devtools.on("Network.loadingFinished", self._came)
        devtools.send("Network.enable")

    @property
    def bytes_of_files(self) -> dict[str, int]:
        """By address, without answers of the API: these grow with what has happened until then."""
        return {url: size for url, size in self.bytes_of.items() if "/api/" not in url}

    def wait_for(self, part: str) -> None:
        """Until an answer from an address with this in it has come, and all others, too."""
        end = time.monotonic() + PATIENCE_S
        while self._open or not any(part in url for url in self.bytes_of):
            assert time.monotonic() < end, (part, self._open)
            self._page.wait_for_timeout(50)  # events come in meanwhile

    def _asked(self, event: dict[str, Any]) -> None:
        self._open[event["requestId"]] = event["request"]["url"]

    def _came(self, event: dict[str, Any]) -> None:
        self.bytes_of[self._open.pop(event["requestId"])] = int(event["encodedDataLength"])
