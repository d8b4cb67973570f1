"""I2C bus for the drivers: one method, `transfer`, and errors by cause.

A bus uses an adapter that accepts smbus2 `i2c_msg` objects and raises bare `OSError` with the
kernel's errno: `smbus2.SMBus` on a Raspberry Pi, a register-level model in an emulation. This
module classifies the errno (hardware.md 3.2 to 3.4), so the emulation exercises that too.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
from typing import Protocol

from smbus2 import SMBus, i2c_msg
from smbus2.smbus2 import I2C_RDWR, i2c_rdwr_ioctl_data

from devices.buses.device_files import DeviceReopener
from devices.buses.usb_adapters import find_bus_file
from devices.errors import (
    BusFaultError,
    BusLostError,
    BusMisuseError,
    BusSetupError,
    I2cError,
    NoAcknowledgeError,
    UsageError,
)

__all__ = ["I2cAdapter", "I2cBus", "i2c_msg", "open_bus"]

# include/uapi/linux/i2c-dev.h: adapter timeout in units of 10 ms, sticky. The core's default of
# about 1 s would stall the loop for hundreds of frames on one wedged transfer.
I2C_TIMEOUT = 0x0702
TIMEOUT_10MS = 3

READ_BUFFER_FILL = 0xFF
"""Content of a read buffer before the transfer, so that stale bytes cannot pass as a reading if an
adapter leaves the buffer as it is. No working part returns it (see `ChipDriver.classify_counts`),
and no mux has all channels open."""
_READ = 0x0001  # I2C_M_RD, include/uapi/linux/i2c.h

_NACK = {errno.ENXIO, errno.EREMOTEIO}
_BUS = {errno.EIO, errno.ETIMEDOUT, errno.EAGAIN, errno.EBUSY}
_MISUSE = {errno.EINVAL, errno.EOPNOTSUPP}


class I2cAdapter(Protocol):
    """Adapter beneath a bus: `smbus2.SMBus`, or an emulated one."""

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """Run one I2C_RDWR transaction: START, repeated STARTs between messages, one STOP."""

    def set_timeout(self, units_10ms: int) -> None:
        """Set the timeout of a wedged transfer (ioctl I2C_TIMEOUT)."""

    def close(self) -> None:
        """Release the adapter."""


class _Smbus(SMBus):
    """smbus2's adapter, with I2C_TIMEOUT and a check of the ioctl's result."""

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """Run the messages as one transaction.

        The ioctl returns the number of transferred messages, which smbus2 ignores: an adapter that
        stops early without an errno leaves the read buffer as it was.

        Raises:
            OSError: the kernel's; EREMOTEIO if not all messages were transferred.
        """
        if self.fd is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        # smbus2 annotates one sequence instead of arguments.
        data = i2c_rdwr_ioctl_data.create(*i2c_msgs)  # type: ignore[arg-type]
        done = fcntl.ioctl(self.fd, I2C_RDWR, data)
        if done != len(i2c_msgs):
            what = f"{done} of {len(i2c_msgs)} messages transferred"
            raise OSError(errno.EREMOTEIO, what)

    def set_timeout(self, units_10ms: int) -> None:
        if self.fd is not None:
            fcntl.ioctl(self.fd, I2C_TIMEOUT, units_10ms)


class I2cBus:
    """One I2C bus.

    Not thread-safe: one thread owns a bus (smbus2's advice), because a mux selection and the access
    behind it are two transactions that nothing may come between.

    Args:
        adapter: open adapter.
        name: device name, for errors.
        reopener: reopens the adapter after it went away; None: never reopened.
    """

    def __init__(
        self, adapter: I2cAdapter, name: str, reopener: DeviceReopener[I2cAdapter] | None = None
    ) -> None:
        self.name = name
        self._adapter: I2cAdapter | None = adapter
        self._i2c_rdwr = adapter.i2c_rdwr
        self._reopener = reopener

    @property
    def is_open(self) -> bool:
        """True unless the adapter is known to have gone away."""
        return self._adapter is not None

    @property
    def reopen_error(self) -> str:
        """Reason why the last attempt to reopen the adapter failed; empty if it is open."""
        return "" if self._reopener is None or self.is_open else self._reopener.last_error

    def transfer(self, *messages: i2c_msg) -> None:
        """Run `messages` as one transaction; read messages are filled in place.

        Raises:
            NoAcknowledgeError: an address or a byte was not acknowledged.
            BusLostError: the adapter went away; `ensure_open` gets it back.
            BusFaultError: timeout, lost arbitration, or an unspecified I/O error.
            BusMisuseError: the adapter cannot do this sequence (a bug in the driver).
        """
        for message in messages:
            if message.flags & _READ:
                ctypes.memset(message.buf, READ_BUFFER_FILL, message.len)
        try:
            self._i2c_rdwr(*messages)
        except OSError as error:
            found = _classify_error(error, self.name, messages)
            if isinstance(found, BusLostError):
                self.release_adapter()
            raise found from error

    def transfer_once(self, *messages: i2c_msg) -> None:
        """Run a transfer that no kind of bus retries: a part that is busy may be silent."""
        self.transfer(*messages)

    def release_adapter(self) -> None:
        """Close an adapter that no longer works, so that its device number becomes free.

        Without a `reopener` do nothing.
        """
        if self._adapter is None or self._reopener is None:
            return
        with contextlib.suppress(OSError):
            self._adapter.close()
        self._adapter = None
        self._i2c_rdwr = _raise_no_device

    def ensure_open(self, now_ns: int) -> bool:
        """Reopen a closed adapter, at most once a second; return whether the bus is open."""
        if self._adapter is None and self._reopener is not None:
            self._adapter = self._reopener.poll_opened_device(now_ns)
            if self._adapter is not None:
                self._i2c_rdwr = self._adapter.i2c_rdwr
        return self._adapter is not None

    def close(self) -> None:
        """Close the adapter."""
        if self._reopener is not None:
            self._reopener.close()
        if self._adapter is not None:
            self._adapter.close()


def _raise_no_device(*_: i2c_msg) -> None:
    raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))


class RetryingBus(I2cBus):
    """Bus that retries transfers without an acknowledge, for start-up on a disturbed line."""

    TRIES = 4

    def __init__(self, bus: I2cBus) -> None:
        self.name = bus.name
        self._bus = bus
        self.retried_transfers = 0
        """Number of transfers that succeeded only on a retry."""

    def transfer(self, *messages: i2c_msg) -> None:
        """Run a transfer as `I2cBus.transfer`, up to `TRIES` times."""
        for attempt in range(self.TRIES):
            try:
                self._bus.transfer(*messages)
            except NoAcknowledgeError:
                if attempt + 1 == self.TRIES:
                    raise
            else:
                self.retried_transfers += attempt > 0
                return

    def transfer_once(self, *messages: i2c_msg) -> None:
        """Run a transfer without a retry."""
        self._bus.transfer_once(*messages)


def _classify_error(error: OSError, bus: str, messages: tuple[i2c_msg, ...]) -> I2cError:
    number = error.errno
    where = f"{bus}, address 0x{messages[-1].addr:02x}" if messages else bus
    name = errno.errorcode.get(number, str(number)) if number is not None else str(error)
    if number in _NACK:
        return NoAcknowledgeError(
            f"no acknowledge ({name})",
            where=where,
            remedy="Check the plug, the supply and the mux channel",
            errno=number,
        )
    if number in _BUS:
        return BusFaultError(
            f"the bus failed ({name})",
            where=where,
            remedy="Check that SDA and SCL are high when idle; if not, reset mux and tile supply",
            errno=number,
        )
    if number in _MISUSE:
        return BusMisuseError(
            f"the adapter refused the transfer ({name})",
            where=where,
            expected="at most 42 messages, of which one read message, and it last",
            errno=number,
        )
    return BusLostError(
        f"the adapter is missing ({name})",
        where=where,
        remedy="Check its plug and its supply; it is reopened automatically",
        errno=number,
    )


def _open_adapter(name: str, emulated: I2cAdapter | None) -> I2cAdapter:
    adapter = emulated
    file = name if adapter is not None else find_bus_file(name)
    try:
        if adapter is None:
            adapter = _Smbus(file)
        adapter.set_timeout(TIMEOUT_10MS)
    except OSError as error:
        if adapter is not None:
            adapter.close()
        number = error.errno
        reason = errno.errorcode.get(number, str(number)) if number is not None else str(error)
        raise BusSetupError(
            f"the bus cannot be used ({reason})",
            where=name,
            remedy="Check that the device exists, that I2C is enabled (dtparam=i2c_arm=on) and "
            "that this user is in the group i2c",
            errno=number,
        ) from error
    return adapter


def open_bus(name: str, emulated: I2cAdapter | None = None) -> I2cBus:
    """Open the bus `name`: a device such as `/dev/i2c-1`, a USB adapter, or `"emulated"`.

    The caller creates and passes the emulated adapter.

    Raises:
        BusSetupError: the device is missing or may not be opened.
        UsageError: `"emulated"` without an emulated adapter.
    """
    if name != "emulated":
        emulated = None
    elif emulated is None:
        raise UsageError("bus 'emulated' needs an emulated world, and none was given")
    reopener = DeviceReopener(
        lambda: _open_adapter(name, emulated), is_synchronous=emulated is not None
    )
    return I2cBus(_open_adapter(name, emulated), name, reopener)
