"""A virtual machine with Debian's kernel and this machine's files, to run commands in.

Its root is this machine's, read-only by 9p; what it writes stays in its memory. It reaches this
machine's loopback as `HOST`. QEMU emulates its processor, ten times slower than this one.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

HOST = "10.0.2.2"
AUTHKEY = b"guest"
"""Only against a stranger's accident: both ends are on this machine's loopback."""
BOOT_S = 300.0
_MODULES = ("virtio_pci", "virtio_net", "9pnet_virtio", "9p", "overlay")
"""What the guest needs before it sees any file."""
_AGENT = Path(__file__).with_name("guest_agent.py")

_INIT = """#!/bin/busybox sh
b=/bin/busybox
$b mkdir -p /proc /sys /dev /root
$b mount -t devtmpfs dev /dev
for module in $($b cat /order); do $b insmod /modules/$module; done
$b mkdir /machine /own
$b mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 host /machine
$b mount -t tmpfs own /own
$b mkdir /own/files /own/work
$b mount -t overlay -o lowerdir=/machine,upperdir=/own/files,workdir=/own/work root /root
$b mount -t devtmpfs dev /root/dev
$b mkdir -p /root/dev/shm /root/dev/pts
$b mount -t tmpfs shm /root/dev/shm
$b mount -t devpts pts /root/dev/pts
$b mount -t proc proc /root/proc
$b mount -t sysfs sys /root/sys
$b mount -t tmpfs -o mode=755 run /root/run
$b ip link set lo up
$b ip address add 10.0.2.15/24 dev eth0
$b ip link set eth0 up
$b ip route add default via 10.0.2.2
exec $b switch_root /root /bin/sh -c '$AGENT; echo o >/proc/sysrq-trigger; read never'
"""


@dataclass(frozen=True)
class Kernel:
    """Debian's kernel, unpacked: image, modules with their dependencies, release."""

    image: Path
    root: Path
    release: str


def find_kernel(folder: Path) -> Kernel:
    """Find the kernel that `scripts/kernel` has unpacked to `folder`.

    Raises:
        FileNotFoundError: it has not.
    """
    images = sorted(folder.glob("boot/vmlinuz-*"))
    if not images:
        raise FileNotFoundError(f"no kernel in {folder}")
    return Kernel(images[-1], folder, images[-1].name.removeprefix("vmlinuz-"))


def _find_module_files(kernel: Kernel) -> list[Path]:
    """Find the modules that the guest needs first, in the order of their loading."""
    found: dict[Path, None] = {}
    for module in _MODULES:
        command = ("/sbin/modprobe", "-d", kernel.root, "-S", kernel.release, "--show-depends")
        done = subprocess.run((*command, module), capture_output=True, text=True, check=True)
        for line in done.stdout.splitlines():
            if line.startswith("insmod"):
                found[Path(line.split()[1])] = None
    return list(found)


def _pack_first_files(kernel: Kernel, agent: str) -> bytes:
    """Pack the first file system of the kernel, a cpio archive ("newc")."""
    modules = _find_module_files(kernel)
    busybox = shutil.which("busybox")
    if busybox is None:
        raise FileNotFoundError("busybox")
    files = {
        "bin": None,
        "bin/busybox": Path(busybox).read_bytes(),
        "modules": None,
        **{f"modules/{path.name}": path.read_bytes() for path in modules},
        "order": "\n".join(path.name for path in modules).encode(),
        "init": _INIT.replace("$AGENT", agent).encode(),
        "TRAILER!!!": b"",
    }
    packed = b""
    for number, (name, data) in enumerate(files.items(), start=1):
        mode = 0o40755 if data is None else 0o100755
        size = len(data or b"")
        fields = (number, mode, 0, 0, 1, 0, size, 0, 0, 0, 0, len(name) + 1, 0)
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
        packed += head + bytes(-len(head) % 4) + (data or b"") + bytes(-size % 4)
    return packed


@dataclass(frozen=True)
class Done:
    """A command that ended: exit code, or the negative signal, and what it said."""

    code: int
    output: str


class Job:
    """A command that was started in the guest."""

    def __init__(self, guest: Guest, process: int, command: str) -> None:
        self._guest, self._process, self._command = guest, process, command
        self._done: Done | None = None

    @property
    def output(self) -> str:
        """What it has said until now."""
        return self._poll()[1]

    def wait_for(self, text: str, timeout_s: float = 90.0) -> None:
        """Wait until it has said a text."""
        self._wait(lambda: text in self.output, timeout_s, f"to say {text!r}")

    def wait(self, timeout_s: float = 120.0) -> Done:
        """Wait until it has ended."""
        self._wait(lambda: self._poll()[0] is not None, timeout_s, "to end")
        assert self._done is not None
        return self._done

    def kill(self, number: int = signal.SIGTERM) -> None:
        """Send a signal to it and to what it started."""
        self._guest.call("kill", self._process, number)

    def _poll(self) -> tuple[int | None, str]:
        if self._done is None:
            code, output = self._guest.call("poll", self._process)
            if code is None:
                return None, output
            self._done = Done(code, output)
        return self._done.code, self._done.output

    def _wait(self, is_true: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not is_true():
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"{self._command} took over {timeout_s} s {what}: {self.output}")
            if self._done is not None:
                raise AssertionError(f"{self._command} ended before: {self._done}")
            time.sleep(0.1)


class Guest:
    """Commands in a running guest."""

    def __init__(self, link: Connection, console: Path) -> None:
        self._link = link
        self.console = console
        """What its kernel prints."""

    def call(self, name: str, *arguments: object) -> Any:
        """Call a function of the guest's agent.

        Raises:
            OSError: what the function raised.
        """
        self._link.send((name, arguments))
        if not self._link.poll(60.0):
            raise TimeoutError(f"the guest does not answer: {self.console.read_text()[-2000:]}")
        answer = self._link.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def start(self, *command: str, user: int = 0, **environment: str) -> Job:
        """Start a command, as root or as a user of no group."""
        process = self.call("start", command, user, environment)
        return Job(self, process, " ".join(command))

    def run(self, *command: str, user: int = 0, timeout_s: float = 120.0) -> Done:
        """Run a command to its end."""
        return self.start(*command, user=user).wait(timeout_s)

    def load_module(self, kernel: Kernel, name: str, *parameters: str) -> None:
        """Load a module of the kernel."""
        done = self.run("/sbin/modprobe", "-d", str(kernel.root), name, *parameters)
        assert done.code == 0, done


@contextmanager
def boot(kernel: Kernel, folder: Path) -> Iterator[Guest]:
    """Boot a guest, and power it off at the end; `folder` is for files of this run."""
    with Listener(("127.0.0.1", 0), authkey=AUTHKEY) as listener:
        port = listener.address[1]
        python = Path(sys.prefix, "bin/python")
        agent = f"cd {Path.cwd()}; {python} {_AGENT} {HOST} {port} {AUTHKEY.decode()}"
        first_files, console = folder / "first_files", folder / "console"
        first_files.write_bytes(_pack_first_files(kernel, agent))
        machine = subprocess.Popen(
            [
                *("qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-smp", "2", "-m", "1024"),
                *("-kernel", kernel.image, "-initrd", first_files, "-no-reboot"),
                *("-append", "console=ttyS0 quiet panic=-1"),
                *("-display", "none", "-serial", f"file:{console}"),
                "-virtfs",
                "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
                *("-nic", "user,model=virtio-net-pci"),
            ],
            stdin=subprocess.DEVNULL,
        )
        try:
            with _accept(listener, machine, console) as link:
                yield Guest(link, console)
            with suppress(subprocess.TimeoutExpired):
                machine.wait(10.0)
        finally:
            machine.kill()
            machine.wait()


def _accept(listener: Listener, machine: subprocess.Popen[bytes], console: Path) -> Connection:
    """Accept the agent's connection, and wait until it is ready."""
    accepted: list[Connection] = []
    thread = threading.Thread(target=lambda: accepted.append(listener.accept()), daemon=True)
    thread.start()
    thread.join(BOOT_S)
    if not accepted or not accepted[0].poll(BOOT_S):
        raise TimeoutError(
            f"no guest after {BOOT_S} s ({machine.poll()}): {console.read_text()[-4000:]}"
        )
    assert accepted[0].recv() == "ready"
    return accepted[0]
