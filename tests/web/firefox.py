"""Firefox without a window, driven through Marionette: Playwright cannot drive Debian's."""

from __future__ import annotations

import base64
import re
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # what it stands on is old
    driver = pytest.importorskip(
        "marionette_driver.marionette", reason="no marionette-driver, which is in the extra `dev`"
    )
    from marionette_driver import errors

from tests.waiting import PATIENCE_S

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
NARROWEST_PX = 500
"""What a window of Firefox is at least; a narrower screen is one on which all is larger."""
ENTER, ESCAPE, RIGHT = "\ue007", "\ue00c", "\ue014"
# What pages say goes to the log, and what the browser says of itself does not, as far as it can.
_PREFERENCES = {
    "devtools.console.stdout.content": True,
    "devtools.console.stdout.chrome": False,
    "browser.dom.window.dump.enabled": True,
    "browser.download.folderList": 2,
    "browser.download.alwaysOpenPanel": False,
}
_COMPLAINT = re.compile(r"console\.(?:warn|error): .*")
_OF_BROWSER = "RSLoader"  # its list of experiments, which it does not get here
_ERRORS = """
const errors = [];
for (const message of Services.console.getMessageArray()) {
  const isOfPage = message instanceof Ci.nsIScriptError && message.category !== "chrome javascript";
  if (isOfPage) errors.push(message.toString());
}
Services.console.reset();
return errors;
"""


class Firefox:
    """One window; what is asked for is waited for."""

    def __init__(self, folder: Path) -> None:
        assert FIREFOX is not None
        self.downloads = folder / "downloads"
        self.downloads.mkdir()
        self._log = folder / "firefox.log"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # sockets, while it is not up yet
            self._driver = driver.Marionette(
                port=0,
                bin=FIREFOX,
                headless=True,
                gecko_log=str(self._log),
                workspace=str(folder),
                prefs={**_PREFERENCES, "browser.download.dir": str(self.downloads)},
            )
        self._heard = 0
        self._driver.start_session()
        self._driver.timeout.implicit = PATIENCE_S

    def close(self) -> None:
        """End it; its profile goes with it."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            self._driver.cleanup()

    def open(self, url: str, width: int = 1366, height: int = 768) -> None:
        """Show a page on a screen of this size."""
        self._driver.navigate(url)
        scale = max(1.0, NARROWEST_PX / width)
        with self._driver.using_context("chrome"):
            self.run("gBrowser.selectedBrowser.fullZoom = arguments[0]", scale)
        outer = round(scale * width), round(scale * height)
        self._driver.set_window_rect(width=outer[0], height=outer[1])
        self.wait("Math.abs(innerWidth - arguments[0]) <= 2", width)
        missing_px = round(scale * (height - self.run("return innerHeight")))
        self._driver.set_window_rect(width=outer[0], height=outer[1] + missing_px)
        self.wait("Math.abs(innerHeight - arguments[0]) <= 2", height)

    def run(self, script: str, *arguments: Any) -> Any:
        """The value of a script, which returns it."""
        return self._driver.execute_script(script, script_args=arguments, sandbox=None)

    def wait(self, condition: str, *arguments: Any) -> Any:
        """The value of an expression as soon as it is true."""
        return self._until(lambda: self.run(f"return {condition}", *arguments), condition)

    def wait_for_text(self, selector: str, text: str) -> None:
        """Wait until this is said there."""
        self.wait(
            "document.querySelector(arguments[0])?.innerText.includes(arguments[1])", selector, text
        )

    def find(self, selector: str) -> Any:
        """The first element of a selector, as soon as there is one."""
        return self._driver.find_element("css selector", selector)

    def click(self, selector: str) -> None:
        """Click, as soon as there is something that can be clicked."""
        clickable = "document.querySelector(arguments[0] + ':not(:disabled)')?.checkVisibility()"

        def clicked() -> bool:
            self.wait(clickable, selector)
            try:
                self.find(selector).click()
            except errors.StaleElementException:  # the page has drawn it anew meanwhile
                return False
            return True

        self._until(clicked, f"a click on {selector}")

    def keys(self, *keys: str) -> None:
        """Press keys, wherever the focus is."""
        self._driver.actions.sequence("key", "keyboard").send_keys("".join(keys)).perform()

    def drag(self, selector: str, from_px: tuple[int, int], to_px: tuple[int, int]) -> None:
        """Press the mouse in an element, `from_px` from its corner, and let it go elsewhere."""
        corner = self.run(
            "const at = document.querySelector(arguments[0]); at.scrollIntoView();"
            "const box = at.getBoundingClientRect(); return [box.left, box.top]",
            selector,
        )
        places = [
            tuple(round(a + b) for a, b in zip(corner, px, strict=True)) for px in (from_px, to_px)
        ]
        mouse = self._driver.actions.sequence("pointer", "mouse", {"pointerType": "mouse"})
        mouse.pointer_move(*places[0]).pointer_down().pointer_move(*places[1], duration=100)
        mouse.pointer_up().perform()

    def downloaded(self, ending: str) -> Path:
        """What has been downloaded, as soon as it is whole."""

        def whole() -> list[Path]:
            under_way = list(self.downloads.glob("*.part"))
            return [] if under_way else list(self.downloads.glob(f"*{ending}"))

        found: list[Path] = self._until(whole, f"a download of {ending}")
        return found[0]

    def picture(self, path: Path) -> None:
        """Write what is on the screen as PNG."""
        path.write_bytes(base64.b64decode(self._driver.screenshot(full=False)))

    def complaints(self) -> list[str]:
        """What pages have complained of since this was last asked: their consoles, and errors."""
        with self._log.open(errors="replace") as log:
            log.seek(self._heard)
            lines = log.readlines()
            self._heard = log.tell()
        said = [line for line in lines if _COMPLAINT.match(line) and _OF_BROWSER not in line]
        with self._driver.using_context("chrome"):
            errors: list[str] = self.run(_ERRORS)
        return said + errors

    @staticmethod
    def _until(condition: Callable[[], Any], what: str) -> Any:
        end_s = time.monotonic() + PATIENCE_S
        while not (found := condition()):
            if time.monotonic() > end_s:
                pytest.fail(f"Firefox: waited {PATIENCE_S} s in vain for {what}")
            time.sleep(0.05)
        return found
