"""One guest for all tests of this folder, with a foot on its USB."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from devices.scene.scene_file import load_scene
from tests.kernel.guest import HOST, Guest, Kernel, boot, find_kernel
from tests.kernel.usb_devices import SCENE, UsbFoot
from tests.waiting import until

MODULES = ("vhci-hcd", "i2c-tiny-usb", "i2c-dev", "cdc-acm", "cuse", "mpl115_i2c")


@pytest.fixture(scope="session")
def kernel() -> Kernel:
    """Debian's kernel; `scripts/kernel` has unpacked it."""
    folder = os.environ.get("FOOTTILE_KERNEL", "")
    if not folder:
        pytest.skip("no kernel is unpacked; run `sh scripts/test --kernel`")
    return find_kernel(Path(folder))


@pytest.fixture(scope="session")
def foot() -> Iterator[UsbFoot]:
    """A foot of four tiles and a servo, on USB."""
    foot = UsbFoot(load_scene(str(SCENE)))
    yield foot
    foot.array_socket.close()


@pytest.fixture(scope="session")
def guest(
    kernel: Kernel, foot: UsbFoot, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Guest]:
    """A guest whose kernel has found array and servo."""
    with foot.serve_servo() as servo, boot(kernel, tmp_path_factory.mktemp("guest")) as guest:
        for module in MODULES:
            guest.load_module(kernel, module)
        guest.call("attach", HOST, servo.port, 1)
        guest.call("attach", HOST, foot.array_socket.port, 0)
        until(lambda: guest.call("glob", "/dev", "i2c-*") and guest.call("glob", "/dev", "ttyACM*"))
        yield guest
