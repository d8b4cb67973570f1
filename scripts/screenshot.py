"""Runs the demo, looks at its page with Chromium, and saves pictures; see `scripts/screenshot`."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from playwright.sync_api import Browser, Page, sync_playwright

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"
SIZES = {"live": (1366, 768, 1), "phone": (390, 844, 2)}
COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
OPTIONS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
LOOK_S = 11.0  # until the trace is full


SESSION_S = 20.0
"""How long the session lasts of whose page there is a picture."""
TOKEN = os.environ.setdefault("FOOTTILE_TOKEN", secrets.token_urlsafe(18))
"""Of demo, node and requests here, which have it from the environment."""


@contextmanager
def demo(*options: str, is_tared: bool = True) -> Iterator[str]:
    """Run a demo; yield the address of its server once its foot is tared, or connected."""
    with tempfile.TemporaryDirectory() as data:
        running = subprocess.Popen(
            [*COMMAND, "demo", "--port=0", f"--data={data}", *options],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert running.stdout is not None
            url = running.stdout.readline().split()[-1].partition("#")[0]
            ready = "tare" if is_tared else "last_seq"
            while not any(node[ready] for node in httpx.get(f"{url}api/v1/nodes").json()["items"]):
                time.sleep(0.2)
            yield url
        finally:
            running.terminate()
            running.wait(30)
            if running.stdout is not None:
                running.stdout.close()


def api_of(url: str) -> httpx.Client:
    """Return a client of the demo's API, with its token."""
    return httpx.Client(base_url=f"{url}api/v1", headers={"Authorization": f"Bearer {TOKEN}"})


def live(browser: Browser) -> None:
    """Shoot the live page, on a laptop and on a phone."""
    with demo(*sys.argv[1:]) as url:
        for name, (width, height, scale) in SIZES.items():
            page = browser.new_page(
                viewport={"width": width, "height": height}, device_scale_factor=scale
            )
            page.goto(url)
            page.wait_for_selector("body[data-live=true]")
            time.sleep(LOOK_S)
            page.wait_for_selector("#cop[data-x-m]:not([data-x-m=''])")
            save(page, name)


def session(browser: Browser) -> None:
    """Shoot the page of a session of a walking foot: two of its stances."""
    with demo("--scene", "poppy") as url, api_of(url) as http:
        body = {
            "node": http.get("/nodes").json()["items"][0]["node"],
            "name": "stones, third trial",
        }
        id_ = http.post(
            "/sessions", json=body | {"subject": "left leg", "tags": ["gravel"]}
        ).json()["id"]
        time.sleep(SESSION_S / 2)
        http.post(f"/sessions/{id_}/events", json={"label": "a stone"})
        time.sleep(SESSION_S / 2)
        http.post(f"/sessions/{id_}/stop", timeout=30.0)
        while http.get(f"/sessions/{id_}").json()["state"] != "sealed":
            time.sleep(0.2)
        series = http.get(f"/sessions/{id_}/timeseries", params={"points": 1}).json()
        begin_ns = series["begin_t_ns"]
        stances = http.get(f"/sessions/{id_}/stances").json()
        # Two whole ones with little time between.
        whole = [
            i for i in range(3, len(stances) - 1) if all(s["is_whole"] for s in stances[i : i + 2])
        ]
        middle = min(whole, key=lambda i: stances[i + 1]["begin_t_ns"] - stances[i]["end_t_ns"])
        begin_s, end_s = (
            (stances[i][at] - begin_ns) * 1e-9
            for i, at in ((middle, "begin_t_ns"), (middle + 1, "end_t_ns"))
        )
        from_s, to_s = begin_s - 0.4, end_s + 0.6
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(f"{url}sessions/{id_}?from={from_s}&to={to_s}")
        page.wait_for_selector("#plots[data-settled=true]")
        page.wait_for_selector("#stances-rows tr")
        box = page.locator("#plots").bounding_box()
        assert box is not None
        # In the first of them: beside the plots are the axis and a margin.
        share = (begin_s + 0.45 * stances[middle]["duration_s"] - from_s) / (to_s - from_s)
        page.mouse.move(box["x"] + 56 + share * (box["width"] - 56 - 12), box["y"] + 100)
        page.wait_for_selector("#readout:not([data-time-s=''])")
        time.sleep(0.5)
        save(page, "session")


def nodes(browser: Browser) -> None:
    """All nodes at once: two feet, both recorded."""
    with demo("--scene", "rolling") as url, api_of(url) as http:
        other = subprocess.Popen(
            [*COMMAND, "node", "--scene=standing", "--name=right", f"--server={url}"]
        )
        try:
            while sum(bool(node["tare"]) for node in http.get("/nodes").json()["items"]) < 2:
                time.sleep(0.2)
            http.post("/takes", json={"name": "both feet, third trial"})
            page = browser.new_page(viewport={"width": 1280, "height": 620})
            page.goto(f"{url}nodes")
            time.sleep(LOOK_S / 2)
            save(page, "nodes")
        finally:
            other.terminate()
            other.wait(30)


ONE_TILE = """
name = "one-tile"
models = ["unwrap", "static", "skew", "denoise"]
[[tile]]
serial = "T01"
mux = 0x70
channel = 0
x_m = 0
y_m = 0
z_m = -0.15
[ground]
kind = "plate"
"""


CALIBRATE_STAGES = {
    # While the third weight is held.
    "hold": "body:has(#steps li li:nth-child(2)[data-state=done]) #ask[data-step=holding]",
    "result": "#accept",
}


def calibrate(browser: Browser) -> None:
    """Shoot the guided calibration: a weight that is held, and the result."""
    with tempfile.TemporaryDirectory() as folder:
        scene, load = Path(folder) / "one.toml", Path(folder) / "weights.csv"
        scene.write_text(ONE_TILE)
        rows = ["time_s,cell1_n"]
        for number, force_n in enumerate((1.961, 4.903, 9.807, 14.710, 19.613)):
            t_s = 20 * number
            rows += [f"{t_s},0", f"{t_s + 8},0", f"{t_s + 8.5},{force_n}", f"{t_s + 19},{force_n}"]
        load.write_text("\n".join([*rows, "99.5,0", "130,0", ""]))
        with demo(f"--scene={scene}", f"--load={load}", "--lead-s=60", is_tared=False) as url:
            page = browser.new_page(viewport={"width": 1100, "height": 670})
            page.goto(f"{url}calibrate#token={TOKEN}")
            page.fill("#within", "0.5")
            page.click("#start")
            for stage, at in CALIBRATE_STAGES.items():
                page.wait_for_selector(at, timeout=240_000)
                time.sleep(2.0)
                save(page, f"calibrate-{stage}")


def save(page: Page, name: str) -> None:
    """Write a picture, and say where."""
    path = FOLDER / f"{name}.png"
    page.screenshot(path=path)
    print(path)


def main() -> None:
    """Take all pictures."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser")
    chromium = next(filter(None, map(shutil.which, names)), None)
    if chromium is None:
        sys.exit("no Chromium; on Debian: sudo apt-get install chromium")
    FOLDER.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
        live(browser)
        session(browser)
        nodes(browser)
        calibrate(browser)
        browser.close()


if __name__ == "__main__":
    main()
