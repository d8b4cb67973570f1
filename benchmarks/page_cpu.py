"""What the live page costs the machine that shows it: a share of one core, as Chromium counts.

Main thread: CPU time of the page's own thread, through the developer tools. All processes: CPU time
of the browser's process tree, with what rasters and composes, which without a graphics card is
software. Run it on a machine that has nothing else to do, against a server that runs already:

    .venv/bin/foottile demo --scene standing --port 8000
    .venv/bin/python benchmarks/page_cpu.py --url http://127.0.0.1:8000/ --seconds 20
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from pathlib import Path

from playwright.sync_api import CDPSession, sync_playwright

OPTIONS = ["--no-sandbox", "--no-first-run", "--disable-background-networking"]
VIEWS = {"laptop": (1280, 800), "phone": (390, 844)}
SETTLE_S = 5.0


def tree_cpu_s(root: int) -> float:
    """CPU seconds of a process and all that it has started, so far."""
    parents: dict[int, int] = {}
    spent_s: dict[int, float] = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            after = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it ended meanwhile
        parents[int(folder.name)] = int(after[1])
        spent_s[int(folder.name)] = (int(after[11]) + int(after[12])) / os.sysconf("SC_CLK_TCK")

    def is_of(pid: int) -> bool:
        while pid > 1:
            if pid == root:
                return True
            pid = parents.get(pid, 0)
        return False

    return sum(s for pid, s in spent_s.items() if is_of(pid))


def main_thread_s(devtools: CDPSession) -> float:
    metrics = devtools.send("Performance.getMetrics")["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000/")
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    print(f"load average before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with sync_playwright() as playwright:
        for name, (width, height) in VIEWS.items():
            for shown in ("bars", "traces"):
                before = {int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit()}
                browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
                page = browser.new_page(viewport={"width": width, "height": height})
                page.goto(asked.url)
                page.wait_for_selector("body[data-live=true]")
                page.click(f"#as-{shown}")
                tiles = page.locator("#bars .tile").count()
                devtools = page.context.new_cdp_session(page)
                devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
                time.sleep(SETTLE_S)
                root = min(_browsers(before))
                begin_s, main_s, all_s = time.monotonic(), main_thread_s(devtools), tree_cpu_s(root)
                time.sleep(asked.seconds)
                lasted_s = time.monotonic() - begin_s
                main = (main_thread_s(devtools) - main_s) / lasted_s
                whole = (tree_cpu_s(root) - all_s) / lasted_s
                what = f"{name}, {tiles or 'as traces, some'} tiles, {shown}"
                print(f"{what}: main thread {main:.1%}, all processes {whole:.1%} of a core")
                browser.close()


def _browsers(before: set[int]) -> list[int]:
    """Processes that are new and a browser's."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) not in before:
            try:
                words = (folder / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"--remote-debugging-pipe" in words and not any(
                w.startswith(b"--type=") for w in words
            ):
                found.append(int(folder.name))
    return found


if __name__ == "__main__":
    main()
