"""The harness proves itself: every rule of what a power cut leaves, with real processes."""

# ruff: noqa: S311  # seeded on purpose

from __future__ import annotations

import random
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.faults.checks import sessions_are_whole
from tests.faults.conftest import ROOT
from tests.faults.draws import RandomDraws, Remains, Tree, every_outcome
from tests.faults.power import Disk, write_tree
from tests.service.process import has_ended
from tests.service.sessions.crashed import ID, info_of, loaded, session, stream
from tests.waiting import until

Run = Callable[..., Any]

BEGIN = f"""
import os, shutil, sys
from pathlib import Path
sys.path.append({str(ROOT)!r})

def sync(path):
    fd = os.open(path, os.O_RDONLY)
    os.fsync(fd)
    os.close(fd)

def write(path, content):
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())

"""


@pytest.fixture
def play(run: Run) -> Run:
    """Run code in the watched folder; `write` of it writes and syncs, `sync` syncs a folder."""
    return lambda code, **environment: run(BEGIN + code, **environment)


def outcomes(disk: Disk) -> list[dict[str, Any]]:
    return [plain(tree) for tree in every_outcome(disk.possible)]


def plain(tree: Tree) -> dict[str, Any]:
    """A tree without the files' modes."""
    return {
        name: node.content if isinstance(node, Remains) else plain(node)
        for name, node in tree.items()
    }


def contents(disk: Disk, name: str) -> set[bytes | None]:
    """What a file may hold; None: it may be absent."""
    return {tree.get(name) for tree in outcomes(disk)}


def before(disk: Disk, **files: bytes) -> None:
    """Have these files on the disk, durable, and nothing else."""
    for path in disk.root.iterdir():
        path.unlink()
    write_tree({name: Remains(content, 0o644) for name, content in files.items()}, disk.root)
    disk.begin()


def test_bytes_appended_since_the_last_sync_are_anything_and_those_before_stay(
    disk: Disk, play: Run
) -> None:
    play(
        "f = open('a', 'wb', buffering=0); f.write(b'old'); os.fdatasync(f); sync('.')\n"
        "f.write(b'new' * 2000)"
    )
    found = contents(disk, "a")
    assert all(content is not None and content.startswith(b"old") for content in found)
    assert {b"old", b"old" + b"new" * 2000, b"old" + b"new" * 1000} <= found


def test_a_spawned_child_is_watched_too(disk: Disk, run: Run) -> None:
    script = disk.root.parent / "spawn.py"
    script.write_text(f"""{BEGIN}
def work():
    write('a', b'new')
    sync('.')

if __name__ == '__main__':
    import multiprocessing
    child = multiprocessing.get_context('spawn').Process(target=work)
    child.start(); child.join()
""")
    run(
        f"import runpy, sys; sys.argv = [{str(script)!r}]; runpy.run_path({str(script)!r}, "
        "run_name='__main__')"
    )
    assert contents(disk, "a") == {b"new"}


def test_each_power_cut_is_another_boot_of_the_kernel_to_the_processes(
    disk: Disk, play: Run
) -> None:
    boot_id = Path("/proc/sys/kernel/random/boot_id")
    ask = f"print(Path({str(boot_id)!r}).read_text().strip(), end='')"
    first = play(ask).out
    assert play(ask).out == first
    disk.cut_power(random.Random(1))
    assert len({boot_id.read_text().strip(), first, play(ask).out}) == 3


# --- a kill at a chosen point ---------------------------------------------------------------------


def test_a_kill_can_be_armed_while_the_process_runs(disk: Disk, play: Run, tmp_path: Path) -> None:
    arm = tmp_path / "arm"
    code = f"os.mkdir('a'); Path({str(arm)!r}).write_text('mkdir:2\\n'); os.mkdir('b')\n"
    ended = play(code + "os.mkdir('c'); os.mkdir('d')", FAULTS_KILL_FILE=str(arm))
    assert ended.code == -signal.SIGKILL
    assert sorted(path.name for path in disk.root.iterdir()) == ["a", "b"]


def test_a_process_under_test_does_not_outlive_a_harness_that_is_killed(run: Run) -> None:
    code = """
import os, signal, subprocess, sys
sleeper = [sys.executable, "-c", "import time; print(1, flush=True); time.sleep(60)"]
environment = {**os.environ, "FAULTS_PARENT": str(os.getpid())}
child = subprocess.Popen(sleeper, env=environment, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    pid = int(run(code).out)

    until(lambda: has_ended(pid), 5.0)  # it would sleep for a minute


# --- the product's own protocol, and broken ones --------------------------------------------------

WHOLE = "from storage.durable_files import write_atomically\nwrite_atomically(Path('a'), NEW)"
WITHOUT_FSYNC = "Path('.a.tmp').write_bytes(NEW); os.replace('.a.tmp', 'a'); sync('.')"
WITHOUT_FOLDER = "write('.a.tmp', NEW); os.replace('.a.tmp', 'a')"
OLD, NEW = b"old" * 400, b"new" * 400


@pytest.mark.parametrize(
    ("code", "meanwhile", "at_the_end"),
    [(WHOLE, {OLD, NEW}, {NEW}), (WITHOUT_FOLDER, {OLD, NEW}, {OLD, NEW})],
)
def test_an_atomic_writer_leaves_the_old_or_the_new_content_at_any_power_cut(
    disk: Disk, play: Run, code: str, meanwhile: set[bytes], at_the_end: set[bytes]
) -> None:
    assert every_cut(disk, play, code) == (meanwhile, at_the_end)


def test_a_writer_that_renames_what_it_has_not_synced_is_caught(disk: Disk, play: Run) -> None:
    _, at_the_end = every_cut(disk, play, WITHOUT_FSYNC)
    assert {b"", bytes(1200)} <= at_the_end


def every_cut(disk: Disk, play: Run, code: str) -> tuple[set[bytes | None], set[bytes | None]]:
    """What `a` may hold if the power fails at any call of `code`, and what when it has ended."""
    found: set[bytes | None] = set()
    for number in range(1, 20):
        for when in ("before", "after"):
            before(disk, a=OLD)
            ended = play(f"NEW = {NEW!r}\n{code}", FAULTS_KILL=f"any:{number}:{when}")
            found |= contents(disk, "a")
            if ended.code == 0:
                return found, contents(disk, "a")
    raise AssertionError("it makes ever more calls")


SEAL = """
real, left_out = os.fsync, {left_out!r}
def fsync(descriptor):
    number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
    if left_out not in os.readlink(f"/proc/self/fd/{{number}}"):
        real(descriptor)
os.fsync = fsync
from service.sessions.recovery import recover_locked_folder
recover_locked_folder(Path("."))
"""


@pytest.mark.parametrize(
    ("left_out", "finding"),
    [
        ("nothing", None),
        (".frames.parquet", "frames.parquet of .* is damaged"),
        (".session.json", "session.json of .* is damaged"),
    ],
)
def test_a_sync_that_is_missing_in_the_product_is_found_by_the_cuts_behind_it(
    disk: Disk, play: Run, left_out: str, finding: str | None
) -> None:
    stream(disk.root, info_of(), (0, 99), next_seq=100)
    session(disk.root)
    disk.begin()
    assert play(SEAL.format(left_out=left_out)).code == 0
    assert loaded(disk.root).state == "sealed"
    rng = random.Random(1)
    trees = [disk.possible(RandomDraws(rng)) for _ in range(40)]
    found = " ".join(said for tree in trees for said in sessions_are_whole(tree, ID))
    assert bool(found) == (finding is not None), found
    assert finding is None or re.search(finding, found)
