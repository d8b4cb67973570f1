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
from tests.faults.power import Disk, read_tree, write_tree
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


def test_unsynced_bytes_may_be_lost_torn_or_somebody_elses(disk: Disk, play: Run) -> None:
    play("Path('a').write_bytes(b'new' * 100)")
    found = contents(disk, "a")
    assert {None, b"", b"new" * 100, b"new" * 50, bytes(300)} <= found
    assert any(c is not None and c.strip(b"\0") not in b"new" * 100 for c in found)


def test_a_synced_file_keeps_its_bytes_but_its_name_only_when_the_folder_is_synced(
    disk: Disk, play: Run
) -> None:
    play("write('a', b'new')")
    assert contents(disk, "a") == {None, b"new"}
    play("sync('.')")
    assert contents(disk, "a") == {b"new"}


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


def test_bytes_written_over_synced_ones_are_old_or_new_by_sector_until_they_are_synced(
    disk: Disk, play: Run
) -> None:
    before(disk, a=b"old" * 4096)
    over = "f = open('a', 'r+b', buffering=0); f.seek(3000); f.write(b'new' * 1000)\n"
    play(over)
    old = b"old" * 4096
    new = old[:3000] + b"new" * 1000 + old[6000:]
    torn = contents(disk, "a") - {old, new}
    assert contents(disk, "a") >= {old, new}
    (found,) = torn
    assert found is not None
    for at in range(0, len(old), 512):
        assert found[at : at + 512] in (old[at : at + 512], new[at : at + 512])
    play("f = open('a', 'r+b'); os.fsync(f)")
    assert contents(disk, "a") == {new}
    play("f = open('a', 'r+b', buffering=0); f.write(b'x'); os.fsync(f); f.write(b'yz')")
    assert contents(disk, "a") == {b"x" + new[1:], b"xyz" + new[3:]}


def test_a_rename_is_undone_as_a_whole_until_its_folder_is_synced(disk: Disk, play: Run) -> None:
    before(disk, final=b"old")
    play("write('tmp', b'new'); sync('.'); os.replace('tmp', 'final')")
    assert (disk.root / "final").read_bytes() == b"new"
    assert outcomes(disk) == [{"final": b"old", "tmp": b"new"}, {"final": b"new"}]


@pytest.mark.parametrize("remove", ["os.unlink('a')", "os.remove('a')", "Path('a').unlink()"])
def test_an_unlinked_file_may_be_back_until_its_folder_is_synced_and_is_let_go_then(
    disk: Disk, play: Run, remove: str
) -> None:
    before(disk, a=b"old")
    play(remove)
    assert not (disk.root / "a").exists()
    assert contents(disk, "a") == {None, b"old"}
    play("Path('b').touch(); sync('.')")
    assert contents(disk, "a") == {None}


def test_a_full_disk_gets_the_room_of_a_file_back_when_its_end_is_durable(
    disk: Disk, play: Run
) -> None:
    before(disk, a=b"old")
    play("os.unlink('a'); sync('.')")
    assert not list(disk.graveyard.iterdir())


def test_a_folder_that_was_made_is_nothing_before_its_parent_is_synced(
    disk: Disk, play: Run
) -> None:
    play("os.makedirs('d/e'); write('d/e/a', b'new'); sync('d/e'); sync('d')")
    whole = {"d": {"e": {"a": b"new"}}}
    assert outcomes(disk) == [{}, whole]
    play("sync('.')")
    assert outcomes(disk) == [whole]


def test_a_removed_tree_may_be_back_with_all_that_was_in_it(disk: Disk, play: Run) -> None:
    (disk.root / "d" / "e").mkdir(parents=True)
    (disk.root / "d" / "e" / "a").write_bytes(b"old")
    disk.begin()
    play("shutil.rmtree('d')")
    assert not list(disk.root.iterdir())
    found = outcomes(disk)
    assert {} in found
    assert {"d": {"e": {"a": b"old"}}} in found


@pytest.mark.parametrize("cut", ["os.truncate('a', 1)", "f = open('a', 'wb')"])
def test_bytes_cut_off_a_file_may_be_back_until_it_is_synced(
    disk: Disk, play: Run, cut: str
) -> None:
    before(disk, a=b"old")
    play(cut)
    now = (disk.root / "a").read_bytes()
    assert len(now) < 3
    assert contents(disk, "a") == {b"old", now}
    play("f = open('a', 'ab'); os.fsync(f)")
    assert contents(disk, "a") == {now}


def test_a_mapped_file_may_hold_anything(disk: Disk, play: Run) -> None:
    play("write('in_flight.bin', b'x' * 4096); sync('.')")
    found = contents(disk, "in_flight.bin")
    assert {bytes(4096), b"x" * 4096} <= found
    assert len(found) == 4


def test_an_inode_number_that_is_used_again_takes_nothing_of_its_past_with_it(
    disk: Disk, play: Run
) -> None:
    play(
        "for n in range(50):\n"
        "    write('a', b'x' * 100); sync('.'); os.unlink('a'); sync('.')\n"
        "open('a', 'wb').write(b'y' * 100); sync('.')"
    )
    assert b"" in contents(disk, "a")


def test_syncs_of_two_processes_count_together(disk: Disk, play: Run) -> None:
    child = BEGIN + "write('a', b'new')"
    play(f"import subprocess; subprocess.run([sys.executable, '-c', {child!r}]); sync('.')")
    assert contents(disk, "a") == {b"new"}


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


def test_a_cut_is_the_same_for_the_same_seed_and_leaves_nothing_pending(
    disk: Disk, play: Run
) -> None:
    play("[Path(f'{n}').write_bytes(b'x' * n) for n in range(40)]; sync('.')")
    expected = plain(disk.possible(RandomDraws(random.Random(7))))
    disk.cut_power(random.Random(7))
    assert plain(read_tree(disk.root)) == expected
    assert len(outcomes(disk)) == 1


# --- a kill at a chosen point ---------------------------------------------------------------------


def test_a_process_kills_itself_at_the_chosen_call(disk: Disk, play: Run) -> None:
    made = "[Path(f'{n}').mkdir() for n in range(5)]"
    twice = "[(os.mkdir(n), os.rmdir(n)) for n in 'ab']"
    for code, kill, ends_with, left in (
        (made, "mkdir:3:before", -signal.SIGKILL, ["0", "1"]),
        ("os.rename('0', '7')", "rename@/7:1:after", -signal.SIGKILL, ["1", "7"]),
        ("os.rename('1', '8'); os.rmdir('8')", "rename@/7:1:after", 0, ["7"]),
        (twice, "mkdir+rmdir:3", -signal.SIGKILL, ["7"]),
    ):
        assert play(code, FAULTS_KILL=kill).code == ends_with
        assert sorted(path.name for path in disk.root.iterdir()) == left


def test_a_kill_can_be_armed_while_the_process_runs(disk: Disk, play: Run, tmp_path: Path) -> None:
    arm = tmp_path / "arm"
    code = f"os.mkdir('a'); Path({str(arm)!r}).write_text('mkdir:2\\n'); os.mkdir('b')\n"
    ended = play(code + "os.mkdir('c'); os.mkdir('d')", FAULTS_KILL_FILE=str(arm))
    assert ended.code == -signal.SIGKILL
    assert sorted(path.name for path in disk.root.iterdir()) == ["a", "b"]


def test_a_process_under_test_does_not_outlive_a_harness_that_is_killed(run: Run) -> None:
    code = """
import os, signal, subprocess, sys
sleeper = [sys.executable, "-c", "import time; print(1, flush=True); time.sleep(600)"]
environment = {**os.environ, "FAULTS_PARENT": str(os.getpid())}
child = subprocess.Popen(sleeper, env=environment, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    pid = int(run(code).out)

    until(lambda: has_ended(pid))  # it would sleep for ten minutes


# --- the product's own protocol, and broken ones --------------------------------------------------

WHOLE = "from storage.durable_files import write_atomically\nwrite_atomically(Path('a'), NEW)"
WITHOUT_FSYNC = "Path('.a.tmp').write_bytes(NEW); os.replace('.a.tmp', 'a'); sync('.')"
WITHOUT_FOLDER = "write('.a.tmp', NEW); os.replace('.a.tmp', 'a')"
IN_PLACE = "write('a', NEW); sync('.')"
OVER = "f = open('a', 'r+b', buffering=0); f.write(NEW); os.fsync(f)"
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


@pytest.mark.parametrize("code", [IN_PLACE, OVER])
def test_a_writer_in_place_is_caught(disk: Disk, play: Run, code: str) -> None:
    found, at_the_end = every_cut(disk, play, code)
    assert found - {OLD, NEW}
    assert (b"" in found) == (code == IN_PLACE)  # which cuts the file before it writes
    assert at_the_end == {NEW}


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
