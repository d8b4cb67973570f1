"""USB devices for a guest's kernel, over USB/IP: an I2C adapter and a serial port with a servo.

The adapter speaks the protocol of i2c-tiny-usb (drivers/i2c/busses/i2c-tiny-usb.c). What answers
behind it are the emulated chips and the emulated servo. Both run in this process, in real time.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from usbip import Interface, Stall, USBDevice
from usbip.classes.device import CDCACM
from usbip.classes.device.cdc_acm import LineCoding
from usbip.core import VENDOR, Setup, Urb
from usbip.protocol import serve_connection

from devices.buses.i2c import i2c_msg
from devices.clock import SystemClock
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.emulation.world import World
from devices.scene.scene_file import Scene

SCENE = Path(__file__).with_name("foot.toml")
TINY_USB = (0x1C40, 0x0534)
SERIAL_PORT = (0x1209, 0x0001)
_GET_FUNC, _SET_DELAY, _GET_STATUS, _I2C_IO = 1, 2, 3, 4
_BEGIN, _END = 1, 2
_ACKNOWLEDGED, _NOT_ACKNOWLEDGED = b"\x01", b"\x02"
_READ = 0x0001
_FUNCTIONS = struct.pack("<I", 0x0EFF0001)
"""I2C_FUNC_I2C and I2C_FUNC_SMBUS_EMUL (include/uapi/linux/i2c.h)."""


class TinyUsb(Interface):  # type: ignore[misc]  # the library has no types
    """The firmware of an i2c-tiny-usb: a control transfer a message, and one for its status."""

    def __init__(self, bus: EmulatedI2cAdapter) -> None:
        super().__init__()
        self._bus = bus
        self._status = b"\x00"
        self.is_broken = False
        """Stalls each I2C message, as a firmware that has lost its bus."""
        self.hangs = False
        """Reads get no answer, in the middle of their transaction, until the kernel gives up."""
        self.is_hanging = False
        """True once a read hangs."""
        self._is_in_transaction = False

    def answer(self, setup: Setup, data: bytes = b"") -> bytes:
        """Answer a vendor request."""
        if setup.bRequest == _GET_FUNC:
            return _FUNCTIONS
        if setup.bRequest == _GET_STATUS:
            return self._status
        if not setup.bRequest & _I2C_IO:
            return b""
        if self.is_broken:
            raise Stall
        return self._run_message(setup, data)

    def _run_message(self, setup: Setup, data: bytes) -> bytes:
        reading = bool(setup.wValue & _READ)
        address = setup.wIndex
        message = (
            i2c_msg.read(address, setup.wLength) if reading else i2c_msg.write(address, list(data))
        )
        if setup.bRequest & _BEGIN:
            if self._is_in_transaction:  # the kernel gave the last one up
                self._bus.stop_transaction()
            self._bus.begin_transaction()
            self._is_in_transaction = True
        try:
            self._bus.run_message(message)
        except OSError:
            self._status = _NOT_ACKNOWLEDGED
        else:
            self._status = _ACKNOWLEDGED
        if setup.bRequest & _END or self._status == _NOT_ACKNOWLEDGED:
            self._bus.stop_transaction()
            self._is_in_transaction = False
        return bytes(message) if reading else b""


class Stick(USBDevice):  # type: ignore[misc]  # the library has no types
    """The USB device of the adapter."""

    def __init__(self, adapter: TinyUsb) -> None:
        super().__init__(*TINY_USB, product="i2c-tiny-usb", serial="1")
        self._adapter = adapter
        self.add(adapter)
        for number in (adapter.interface_number, None):  # wIndex is an I2C address
            self.on_control(number, adapter.answer)

    def handle_urb(self, urb: Urb, respond: Callable[[Urb], None] | None = None) -> Urb | None:
        """Answer a transfer, or leave it without an answer."""
        if self._adapter.hangs and urb.ep == 0:
            setup = Setup.parse(urb.setup)
            if setup.type == VENDOR and setup.bRequest & _I2C_IO and setup.wValue & _READ:
                self._adapter.is_hanging = True
                return None
        return super().handle_urb(urb, respond)


class UsbSocket:
    """A port of this machine at which a guest attaches a device, while that is plugged in."""

    def __init__(self, device: USBDevice) -> None:
        self._device = device
        device.busid, device.busnum, device.devnum = "1-1", 1, 2
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._cable: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, name="USB device", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the device out; it can be attached again."""
        if self._cable is not None:
            with suppress(OSError):
                self._cable.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Pull it out for good."""
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self.unplug()
        self._server.close()
        self._thread.join()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                self._cable, _ = self._server.accept()
                self._cable.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                with suppress(OSError):
                    serve_connection(self._cable, [self._device])


class UsbFoot:
    """An emulated foot whose array and servo hang on USB."""

    def __init__(self, scene: Scene) -> None:
        self._clock = SystemClock()
        self._scene = scene
        self.world = World(scene, self._clock, in_real_time=True)
        self.adapter = TinyUsb(self.world.i2c_adapter)
        self.array_socket = UsbSocket(Stick(self.adapter))

    @contextmanager
    def serve_servo(self) -> Iterator[UsbSocket]:
        """Serve the serial port, with the scene's servo on its line."""
        section = self._scene.servo
        assert section is not None
        with self.world.open_servo(section, self._clock) as servo:
            line = os.open(servo.port, os.O_RDWR | os.O_NOCTTY)

            def set_speed(_port: object, coding: LineCoding) -> None:
                mode = termios.tcgetattr(line)
                mode[4] = mode[5] = getattr(termios, f"B{coding.baud}")
                termios.tcsetattr(line, termios.TCSANOW, mode)

            serial = CDCACM(on_rx=lambda _, data: os.write(line, data), on_line_coding=set_speed)
            device = USBDevice(*SERIAL_PORT, product="servo", serial="2")
            port = device.add(serial)
            ending = threading.Event()

            def pass_answers() -> None:
                while not ending.is_set():
                    if select.select([line], [], [], 0.1)[0]:
                        port.write(os.read(line, 4096))

            thread = threading.Thread(target=pass_answers, name="servo's answers")
            thread.start()
            usb_socket = UsbSocket(device)
            try:
                yield usb_socket
            finally:
                usb_socket.close()
                ending.set()
                thread.join()
                os.close(line)
