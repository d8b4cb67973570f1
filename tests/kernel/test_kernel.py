"""The unchanged node on the kernel's own I2C stack: errno, short transfers, unplugging, signals."""

from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import foottile
from devices.chips.pressure_chip import Counts, Registers
from devices.chips.pressure_chips import get_chip
from devices.flags import FrameFlag, TileFlag
from foottile.errors import ConflictError
from tests.kernel import cuse_bus
from tests.kernel.guest import HOST, Guest, Job, Kernel
from tests.kernel.usb_devices import SCENE, UsbFoot
from tests.service.process import Process
from tests.tokens import SHARED_TOKEN
from tests.waiting import until

BUS = "usb:1c40:0534"
START_S = 240.0
"""How long a node may take to start: under an emulated processor its imports take a minute."""
TILES = 4

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def server_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server on this machine, which the guest reaches."""
    folder = tmp_path_factory.mktemp("server")
    server = Process(
        "serve", "--port=0", f"--data={folder / 'data'}", f"--allow-host={HOST}", folder=folder
    )
    yield "http://" + server.said("http://").split("http://")[1].split()[0].rstrip("/")
    server.close()


@dataclass
class Recorded:
    """A session that a node in the guest records; its columns once it is sealed."""

    node: Job
    columns: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    begins_s: dict[str, float] = field(default_factory=dict)
    ends_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def named(self, what: str) -> Iterator[None]:
        """Name a stretch of time."""
        self.begins_s[what] = time.time()
        yield
        self.ends_s[what] = time.time()

    def within(self, what: str) -> npt.NDArray[np.bool_]:
        """Which frames are of that stretch: without its first and last second."""
        t_s = self.columns["t_server_ns"] / 1e9
        return (t_s > self.begins_s[what] + 1.0) & (t_s < self.ends_s[what] - 1.0)

    def has_flag(self, flag: TileFlag, tile: int) -> npt.NDArray[np.bool_]:
        return np.asarray((self.columns[f"tile_flags_{tile}"] & flag) != 0)

    def has_frame_flag(self, flag: FrameFlag) -> npt.NDArray[np.bool_]:
        return np.asarray((self.columns["frame_flags"] & flag) != 0)


@contextmanager
def recorded(guest: Guest, server_url: str, name: str, *options: str) -> Iterator[Recorded]:
    """Record while the block runs; then stop, seal and read the session, which must be complete."""
    port = server_url.rpartition(":")[2]
    node = guest.start(
        *("foottile", "node", "--scene", str(SCENE), "--name", name, *options),
        *("--server", f"http://{HOST}:{port}", "--journal", f"/run/{name}"),
        FOOTTILE_TOKEN=SHARED_TOKEN,
    )
    node.wait_for("tiles at", START_S)
    with foottile.connect(server_url, token=SHARED_TOKEN) as server:

        def record() -> foottile.RemoteSession | None:
            try:
                return server.record(name, name)
            except (ConflictError, foottile.NotFoundError):  # no frame has come yet
                return None

        session = until(record)
        assert session is not None
        found = Recorded(node)
        yield found
        session.stop().wait_until_sealed()
        session.refresh()
        assert session.complete is True
        found.columns.update(session.open(clock="server").to_numpy())


def test_doctor_finds_array_and_servo(guest: Guest) -> None:
    # A rate that this machine gives also beside other tests.
    done = guest.run("foottile", "doctor", "--scene", str(SCENE), "--rate-hz", "1")
    assert done.code == 0, done.output
    assert "Adapter i2c-tiny-usb" in done.output
    assert f"{BUS}:1 at /dev/i2c-0" in done.output
    assert "will hold" in done.output
    assert "MX-28, protocol 2, 1000000 baud, id 1" in done.output


def test_a_user_of_no_group_is_told_which(guest: Guest) -> None:
    done = guest.run("foottile", "doctor", "--bus", BUS, user=1000)
    assert done.code == 1, done.output
    assert "EACCES" in done.output
    assert "group i2c" in done.output


def test_i2c_tools_see_what_a_person_on_a_pi_sees(guest: Guest) -> None:
    bus = str(_find_bus(guest)).removeprefix("/dev/i2c-")
    assert guest.run("i2cset", "-y", bus, "0x70", "0x00").code == 0
    assert _detect(guest, bus) == {0x70}
    assert guest.run("i2cset", "-y", bus, "0x70", "0x05").code == 0
    assert _detect(guest, bus) == {0x70, 0x60}
    # The coefficients of the data sheet's table 6 follow the counts: eight bytes from 0x04.
    channel_0 = guest.run("i2cset", "-y", bus, "0x70", "0x01")
    assert channel_0.code == 0
    read = guest.run("i2ctransfer", "-y", bus, "w1@0x60", "0x04", "r8")
    assert read.code == 0, read.output
    assert re.fullmatch(r"(0x[0-9a-f]{2} ?){8}", read.output.strip())


def _detect(guest: Guest, bus: str) -> set[int]:
    done = guest.run("i2cdetect", "-y", bus, "0x60", "0x77")
    assert done.code == 0, done.output
    return {
        int(word, 16)
        for line in done.output.splitlines()[1:]
        for word in line.split()[1:]
        if word != "--"
    }


def test_the_kernels_driver_reads_the_same_pressures(guest: Guest, foot: UsbFoot) -> None:
    """Its arithmetic truncates to a sixteenth of a kilopascal (drivers/iio/pressure/mpl115.c)."""
    bus = str(_find_bus(guest)).removeprefix("/dev/i2c-")
    assert guest.run("i2cset", "-y", bus, "0x70", "0x01").code == 0
    converted: list[tuple[Counts, Registers]] = []
    chip = foot.world.chips[0]
    chip.on_conversion = lambda _, counts, registers: converted.append((counts, registers))
    device_of_bus = Path(f"/sys/bus/i2c/devices/i2c-{bus}")
    try:
        guest.call("write", str(device_of_bus / "new_device"), "mpl115 0x60")
        (device,) = guest.call("glob", "/sys/bus/iio/devices", "iio:device*")
        for _ in range(10):
            converted.clear()
            kernel_kpa = float(guest.call("read", f"{device}/in_pressure_input"))
            counts, registers = converted[-1]
            law = get_chip("mpl115a2").make_law(registers)
            assert abs(law.compute_kpa(*counts) - kernel_kpa) < 1 / 8
    finally:
        chip.on_conversion = None
        guest.call("write", str(device_of_bus / "delete_device"), "0x60")


def test_a_session_over_silence_and_unplugging(
    kernel: Kernel, guest: Guest, foot: UsbFoot, server_url: str
) -> None:
    """A tile falls silent, the adapter fails, is unplugged and comes back as another bus."""
    before = _find_bus(guest)
    with recorded(guest, server_url, "unplugged") as session:
        with session.named("healthy"):
            time.sleep(12.0)
        with session.named("silent"), foot.world.inject_fault("unplugged", "T02"):
            time.sleep(6.0)
        time.sleep(3.0)
        with session.named("broken"):
            foot.adapter.is_broken = True
            time.sleep(6.0)
            foot.adapter.is_broken = False
        time.sleep(6.0)
        foot.array_socket.unplug()
        until(lambda: _takes_number(kernel, guest, before), every_s=1.0)
        guest.call("attach", HOST, foot.array_socket.port, 2)
        assert until(lambda: _find_bus(guest)) != before
        time.sleep(8.0)
        with session.named("back"):
            time.sleep(12.0)
    foot.adapter.hangs = True
    until(lambda: foot.adapter.is_hanging)
    asked_s = time.monotonic()
    session.node.kill(signal.SIGTERM)
    done = session.node.wait()
    took_s = time.monotonic() - asked_s
    foot.adapter.hangs = foot.adapter.is_hanging = False
    assert done.code == 0, done.output
    assert took_s < 15.0, done.output
    for tile in range(TILES):
        no_answer = session.has_flag(TileFlag.NO_ANSWER, tile)
        raw = session.columns[f"pressure_raw_{tile}"]
        assert np.array_equal(np.isnan(raw), no_answer)
        assert not no_answer[session.within("healthy")].any()
        assert not no_answer[session.within("back")].any()
        assert no_answer[session.within("silent")].all() == (tile == 1)
        assert no_answer[session.within("broken")].all()
    assert session.has_frame_flag(FrameFlag.BUS_FAULT)[session.within("broken")].all()
    assert not np.isnan(session.columns["servo_counts"]).any()


def _find_bus(guest: Guest) -> str | None:
    """Find the device file of the adapter."""
    for name in guest.call("glob", "/sys/bus/i2c/devices", "i2c-*/name"):
        if guest.call("read", name).startswith("i2c-tiny-usb"):
            return "/dev/" + Path(name).parent.name
    return None


def _takes_number(kernel: Kernel, guest: Guest, bus: str | None) -> bool:
    """Return whether another adapter has taken a bus's number.

    It is free only when the node has closed its file: until then i2c_del_adapter waits.
    """
    guest.load_module(kernel, "i2c-stub", "chip_addr=0x50")
    (name,) = guest.call("glob", "/sys/bus/i2c/devices", "i2c-*/name")
    if Path(name).parent.name == Path(str(bus)).name:
        return True
    assert guest.run("rmmod", "i2c-stub").code == 0
    return False


def test_transfers_that_only_other_adapters_spoil(
    guest: Guest, foot: UsbFoot, server_url: str
) -> None:
    """An ioctl that ends early without an errno, lost arbitration and clock stretching."""
    spoiler = guest.start(sys.executable, cuse_bus.__file__, str(_find_bus(guest)))
    until(lambda: f"/dev/{cuse_bus.NAME}" in guest.call("glob", "/dev", "i2c-*"))
    spoils = ("short", "EAGAIN", "ETIMEDOUT")
    with recorded(guest, server_url, "spoiled", f"--bus=/dev/{cuse_bus.NAME}") as session:
        with session.named("healthy"):
            time.sleep(8.0)
        for spoil in spoils:
            with session.named(spoil):
                guest.call("write", str(cuse_bus.FAULT), spoil)
                time.sleep(6.0)
                guest.call("write", str(cuse_bus.FAULT), "")
            time.sleep(6.0)
    session.node.kill(signal.SIGTERM)
    assert session.node.wait().code == 0, session.node.output
    spoiler.kill(signal.SIGKILL)
    for tile in range(TILES):
        no_answer = session.has_flag(TileFlag.NO_ANSWER, tile)
        raw = session.columns[f"pressure_raw_{tile}"]
        assert np.array_equal(np.isnan(raw), no_answer)
        assert not no_answer[session.within("healthy")].any()
        for spoil in spoils:
            assert no_answer[session.within(spoil)].all(), spoil


def test_a_kill_within_a_transfer_leaves_a_bus_that_the_next_start_uses(
    guest: Guest, foot: UsbFoot
) -> None:
    foot.adapter.hangs = True
    first = guest.start("foottile", "doctor", "--bus", BUS)
    until(lambda: foot.adapter.is_hanging)
    first.kill(signal.SIGKILL)
    assert first.wait().code == -signal.SIGKILL
    foot.adapter.hangs = foot.adapter.is_hanging = False
    done = guest.run("foottile", "doctor", "--bus", BUS)
    assert done.code == 0, done.output
