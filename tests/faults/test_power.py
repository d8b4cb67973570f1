"""The harness proves itself: every rule of what a power cut leaves, with real processes."""

# ruff: noqa: S311  # seeded on purpose

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.faults.conftest import ROOT
from tests.faults.draws import RandomDraws, Remains, Tree, every_outcome
from tests.faults.power import Disk, write_tree

Run = Callable[..., Any]

BEGIN = f"import os, shutil, sys\nfrom pathlib import Path\nsys.path.append({str(ROOT)!r})\n"
SYNC_FOLDER = """
def sync(path):
    fd = os.open(path, os.O_RDONLY)
    os.fsync(fd)
    os.close(fd)
"""
KILLED = "import signal; os.kill(os.getpid(), signal.SIGKILL)\n"


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


def test_what_was_written_but_not_synced_may_be_lost_torn_or_somebody_elses(
    disk: Disk, run: Run
) -> None:
    run(BEGIN + "Path('a').write_bytes(b'new' * 100)")
    found = contents(disk, "a")
    assert {None, b"", b"new" * 100, b"new" * 50, bytes(300)} <= found
    assert any(c is not None and c.strip(b"\0") not in b"new" * 100 for c in found)


def test_a_synced_file_keeps_its_bytes_but_its_name_only_when_the_folder_is_synced(
    disk: Disk, run: Run
) -> None:
    write = "f = open('a', 'wb'); f.write(b'new'); f.flush(); os.fsync(f.fileno())\n"
    run(BEGIN + write)
    assert contents(disk, "a") == {None, b"new"}
    run(BEGIN + SYNC_FOLDER + "sync('.')")
    assert contents(disk, "a") == {b"new"}


def test_what_was_appended_since_the_last_sync_is_anything_and_what_was_before_it_stays(
    disk: Disk, run: Run
) -> None:
    run(
        BEGIN
        + SYNC_FOLDER
        + "f = open('a', 'wb', buffering=0); f.write(b'old'); os.fdatasync(f); sync('.')\n"
        + "f.write(b'new' * 2000)"
    )
    found = contents(disk, "a")
    assert all(content is not None and content.startswith(b"old") for content in found)
    assert {b"old", b"old" + b"new" * 2000, b"old" + b"new" * 1000} <= found


def test_a_rename_is_undone_as_a_whole_until_its_folder_is_synced(disk: Disk, run: Run) -> None:
    (disk.root / "final").write_bytes(b"old")
    disk.begin()
    write = "f = open('tmp', 'wb'); f.write(b'new'); f.flush(); os.fsync(f.fileno())\n"
    run(BEGIN + SYNC_FOLDER + write + "sync('.'); os.replace('tmp', 'final')")
    assert (disk.root / "final").read_bytes() == b"new"
    assert outcomes(disk) == [{"final": b"old", "tmp": b"new"}, {"final": b"new"}]


@pytest.mark.parametrize("remove", ["os.unlink('a')", "os.remove('a')", "Path('a').unlink()"])
def test_an_unlinked_file_may_be_back_until_its_folder_is_synced(
    disk: Disk, run: Run, remove: str
) -> None:
    (disk.root / "a").write_bytes(b"old")
    disk.begin()
    run(BEGIN + remove)
    assert not (disk.root / "a").exists()
    assert contents(disk, "a") == {None, b"old"}
    run(BEGIN + SYNC_FOLDER + "Path('b').touch(); sync('.')")
    assert contents(disk, "a") == {None}


def test_a_file_is_let_go_when_its_end_is_durable_so_that_a_full_disk_gets_its_room_back(
    disk: Disk, run: Run
) -> None:
    (disk.root / "a").write_bytes(b"old")
    disk.begin()
    run(BEGIN + SYNC_FOLDER + "os.unlink('a'); sync('.')")
    assert not list(disk.graveyard.iterdir())


def test_a_folder_that_was_made_is_nothing_before_its_parent_is_synced(
    disk: Disk, run: Run
) -> None:
    run(
        BEGIN
        + SYNC_FOLDER
        + "os.makedirs('d/e'); f = open('d/e/a', 'wb'); f.write(b'new'); f.flush()\n"
        + "os.fsync(f.fileno()); sync('d/e'); sync('d')"
    )
    whole = {"d": {"e": {"a": b"new"}}}
    assert outcomes(disk) == [{}, whole]
    run(BEGIN + SYNC_FOLDER + "sync('.')")
    assert outcomes(disk) == [whole]


def test_a_removed_tree_may_be_back_with_all_that_was_in_it(disk: Disk, run: Run) -> None:
    (disk.root / "d" / "e").mkdir(parents=True)
    (disk.root / "d" / "e" / "a").write_bytes(b"old")
    disk.begin()
    run(BEGIN + "shutil.rmtree('d')")
    assert not list(disk.root.iterdir())
    found = outcomes(disk)
    assert {} in found
    assert {"d": {"e": {"a": b"old"}}} in found


@pytest.mark.parametrize("cut", ["os.truncate('a', 1)", "f = open('a', 'wb')"])
def test_what_was_cut_off_a_file_may_be_back_until_it_is_synced(
    disk: Disk, run: Run, cut: str
) -> None:
    (disk.root / "a").write_bytes(b"old")
    disk.begin()
    run(BEGIN + cut)
    now = (disk.root / "a").read_bytes()
    assert len(now) < 3
    assert contents(disk, "a") == {b"old", now}
    run(BEGIN + "f = open('a', 'ab'); os.fsync(f)")
    assert contents(disk, "a") == {now}


def test_a_mapped_file_may_hold_anything(disk: Disk, run: Run) -> None:
    run(
        BEGIN
        + SYNC_FOLDER
        + "f = open('in_flight.bin', 'wb'); f.write(b'x' * 4096); f.flush(); os.fsync(f); sync('.')"
    )
    found = contents(disk, "in_flight.bin")
    assert {bytes(4096), b"x" * 4096} <= found
    assert len(found) == 4


def test_an_inode_number_that_is_used_again_takes_nothing_of_its_past_with_it(
    disk: Disk, run: Run
) -> None:
    run(
        BEGIN
        + SYNC_FOLDER
        + "for n in range(50):\n"
        + "    f = open('a', 'wb'); f.write(b'x' * 100); f.flush(); os.fsync(f); sync('.')\n"
        + "    f.close(); os.unlink('a'); sync('.')\n"
        + "open('a', 'wb').write(b'y' * 100); sync('.')"
    )
    assert b"" in contents(disk, "a")


def test_what_two_processes_have_synced_counts_together(disk: Disk, run: Run) -> None:
    child = "import os; f = open('a', 'wb'); f.write(b'new'); f.flush(); os.fsync(f)"
    run(
        BEGIN
        + SYNC_FOLDER
        + f"import subprocess; subprocess.run([sys.executable, '-c', {child!r}]); sync('.')"
    )
    assert contents(disk, "a") == {b"new"}


def test_a_spawned_child_is_watched_too(disk: Disk, run: Run) -> None:
    code = f"""{BEGIN}
def work():
    f = open('a', 'wb'); f.write(b'new'); f.flush(); os.fsync(f)
    fd = os.open('.', os.O_RDONLY); os.fsync(fd)

if __name__ == '__main__':
    import multiprocessing
    child = multiprocessing.get_context('spawn').Process(target=work)
    child.start(); child.join()
"""
    script = disk.root.parent / "spawn.py"
    script.write_text(code)
    run(
        f"import runpy, sys; sys.argv = [{str(script)!r}]; runpy.run_path({str(script)!r}, "
        "run_name='__main__')"
    )
    assert contents(disk, "a") == {b"new"}


def test_each_power_cut_is_another_boot_of_the_kernel_to_the_processes(
    disk: Disk, run: Run
) -> None:
    ask = "print(Path('/proc/sys/kernel/random/boot_id').read_text().strip(), end='')"
    real = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    first = run(BEGIN + ask).out
    assert run(BEGIN + ask).out == first
    disk.cut_power(random.Random(1))
    assert len({real, first, run(BEGIN + ask).out}) == 3


def test_a_cut_is_the_same_for_the_same_seed_and_leaves_nothing_pending(
    disk: Disk, run: Run
) -> None:
    run(BEGIN + SYNC_FOLDER + "[Path(f'{n}').write_bytes(b'x' * n) for n in range(40)]; sync('.')")
    expected = plain(disk.possible(RandomDraws(random.Random(7))))
    disk.cut_power(random.Random(7))
    assert {path.name: path.read_bytes() for path in disk.root.iterdir()} == expected
    assert len(outcomes(disk)) == 1


# --- a kill at a chosen point ---------------------------------------------------------------------


def test_a_process_kills_itself_at_the_chosen_call(disk: Disk, run: Run) -> None:
    code = BEGIN + "[Path(f'{n}').mkdir() for n in range(5)]"
    assert run(code, FAULTS_KILL="mkdir:3:before").code == -signal.SIGKILL
    assert sorted(path.name for path in disk.root.iterdir()) == ["0", "1"]
    assert run(BEGIN + "os.rename('0', '7')", FAULTS_KILL="rename@/7:1:after").code < 0
    assert sorted(path.name for path in disk.root.iterdir()) == ["1", "7"]
    code = BEGIN + "os.rename('1', '8'); os.rmdir('8')"
    assert run(code, FAULTS_KILL="rename@/7:1:after").code == 0
    code = BEGIN + "[(os.mkdir(n), os.rmdir(n)) for n in 'ab']"
    assert run(code, FAULTS_KILL="mkdir+rmdir:3").code == -signal.SIGKILL
    assert sorted(path.name for path in disk.root.iterdir()) == ["7"]


def test_a_kill_can_be_armed_while_the_process_runs(disk: Disk, run: Run, tmp_path: Path) -> None:
    arm = tmp_path / "arm"
    code = f"os.mkdir('a'); Path({str(arm)!r}).write_text('mkdir:2\\n'); os.mkdir('b')\n"
    ended = run(BEGIN + code + "os.mkdir('c'); os.mkdir('d')", FAULTS_KILL_FILE=str(arm))
    assert ended.code == -signal.SIGKILL
    assert sorted(path.name for path in disk.root.iterdir()) == ["a", "b"]


def test_a_process_under_test_does_not_outlive_a_harness_that_is_killed(
    disk: Disk, run: Run
) -> None:
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
    for _ in range(500):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return
        if state == "Z":
            return
        time.sleep(0.01)
    pytest.fail("it lives on")


# --- the product's own protocol, and broken ones --------------------------------------------------

WRITE_WHOLE = """
from storage.durable_files import write_atomically
write_atomically(Path('a'), b'new' * 400)
"""
WITHOUT_FSYNC = """
Path('.a.tmp').write_bytes(b'new' * 400)
os.replace('.a.tmp', 'a')
fd = os.open('.', os.O_RDONLY); os.fsync(fd)
"""
WITHOUT_FOLDER = """
f = open('.a.tmp', 'wb'); f.write(b'new' * 400); f.flush(); os.fsync(f)
os.replace('.a.tmp', 'a')
"""
IN_PLACE = """
f = open('a', 'wb'); f.write(b'new' * 400); f.flush(); os.fsync(f)
fd = os.open('.', os.O_RDONLY); os.fsync(fd)
"""


def every_cut(disk: Disk, run: Run, code: str) -> tuple[set[bytes | None], set[bytes | None]]:
    """What `a` may hold if the power fails at any call of `code`, and what when it has ended."""
    found: set[bytes | None] = set()
    number = 0
    while True:
        write_whole_disk(disk, {"a": Remains(b"old", 0o644)})
        number, when = number + 1, "before"
        ended = run(BEGIN + code, FAULTS_KILL=f"any:{number}:before")
        found |= contents(disk, "a")
        if ended.code == 0:
            return found, contents(disk, "a")
        write_whole_disk(disk, {"a": Remains(b"old", 0o644)})
        run(BEGIN + code, FAULTS_KILL=f"any:{number}:after")
        found |= contents(disk, "a")
        assert number < 20, when


def write_whole_disk(disk: Disk, tree: Tree) -> None:
    for path in disk.root.iterdir():
        path.unlink()
    write_tree(tree, disk.root)
    disk.begin()


def test_write_whole_leaves_the_old_or_the_new_content_whatever_happens_when(
    disk: Disk, run: Run
) -> None:
    found, at_the_end = every_cut(disk, run, WRITE_WHOLE)
    assert found == {b"old", b"new" * 400}
    assert at_the_end == {b"new" * 400}


def test_a_writer_that_renames_what_it_has_not_synced_is_caught(disk: Disk, run: Run) -> None:
    _, at_the_end = every_cut(disk, run, WITHOUT_FSYNC)
    assert {b"", bytes(1200)} <= at_the_end


def test_a_writer_that_does_not_sync_the_folder_is_caught(disk: Disk, run: Run) -> None:
    found, at_the_end = every_cut(disk, run, WITHOUT_FOLDER)
    assert found == at_the_end == {b"old", b"new" * 400}


def test_a_writer_in_place_is_caught(disk: Disk, run: Run) -> None:
    found, at_the_end = every_cut(disk, run, IN_PLACE)
    assert b"" in found
    assert at_the_end == {b"new" * 400}
