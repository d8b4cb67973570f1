"""Runs the demo, looks at its page with Chromium, and saves pictures; see `scripts/screenshot`."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
from playwright.sync_api import sync_playwright

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"
SIZES = {"live": (1366, 768, 1), "phone": (390, 844, 2)}
COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
OPTIONS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
LOOK_S = 11.0  # until the trace is full


def main() -> None:
    """Take all pictures."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("no Chromium; on Debian: sudo apt-get install chromium")
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as data:
        demo = subprocess.Popen(
            [*COMMAND, "demo", "--port=0", f"--data={data}", *sys.argv[1:]],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert demo.stdout is not None
            url = demo.stdout.readline().split()[-1]
            while not any(node["tare"] for node in httpx.get(f"{url}api/v1/nodes").json()["items"]):
                time.sleep(0.2)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
                for name, (width, height, scale) in SIZES.items():
                    page = browser.new_page(
                        viewport={"width": width, "height": height}, device_scale_factor=scale
                    )
                    page.goto(url)
                    page.wait_for_selector("body[data-live=true]")
                    time.sleep(LOOK_S)
                    page.wait_for_selector("#cop[data-x-m]:not([data-x-m=''])")
                    page.screenshot(path=FOLDER / f"{name}.png")
                    print(FOLDER / f"{name}.png")
                browser.close()
        finally:
            demo.terminate()
            demo.wait(30)
            if demo.stdout is not None:
                demo.stdout.close()


if __name__ == "__main__":
    main()
