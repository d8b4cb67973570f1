"""An I2C bus of user space in the guest, which passes transfers on to another and spoils some.

`/dev/i2c-9` by CUSE (fs/fuse/cuse.c, include/uapi/linux/fuse.h). The file FAULT says what happens
to each transfer: `short`: the ioctl returns fewer messages than asked for and no errno, as that of
an adapter that stops early; a name such as EAGAIN: that errno.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import struct
import sys
from contextlib import suppress
from pathlib import Path

FAULT = Path("/run/i2c-9.fault")
NAME = "i2c-9"

_IN, _OUT = struct.Struct("<IIQQIIII"), struct.Struct("<IiQ")
_IOCTL_IN, _IOCTL_OUT = struct.Struct("<QIIQII"), struct.Struct("<iIII")
_OPEN, _RELEASE, _INTERRUPT, _IOCTL, _CUSE_INIT = 14, 18, 36, 39, 4096
_UNRESTRICTED_IOCTL, _RETRY = 1, 4
_I2C_FUNCS, _I2C_RDWR = 0x0705, 0x0707
_RDWR, _MESSAGE = struct.Struct("<QI4x"), struct.Struct("<HHH2xQ")
_READ = 0x0001
_REQUEST_BYTES = 1 << 17


class CuseBus:
    """The device, while `serve` runs."""

    def __init__(self, bus: str) -> None:
        self._bus = os.open(bus, os.O_RDWR)
        self._cuse = os.open("/dev/cuse", os.O_RDWR)

    def serve(self) -> None:
        """Answer requests for ever."""
        while True:
            request = os.read(self._cuse, _REQUEST_BYTES)
            _, opcode, unique, *_ = _IN.unpack_from(request)
            content = request[_IN.size :]
            if opcode == _INTERRUPT:
                continue
            error, answer = 0, b""
            if opcode == _CUSE_INIT:
                version = struct.unpack_from("<II", content)
                answer = (
                    struct.pack("<8I40x", *version, 0, _UNRESTRICTED_IOCTL, 4096, 4096, 0, 0)
                    + f"DEVNAME={NAME}\0".encode()
                )
            elif opcode == _OPEN:
                answer = bytes(16)
            elif opcode == _IOCTL:
                try:
                    answer = self._answer_ioctl(content)
                except OSError as failure:
                    error = -(failure.errno or errno.EIO)
            elif opcode != _RELEASE:
                error = -errno.ENOSYS
            with suppress(FileNotFoundError):  # its caller was killed meanwhile
                os.write(self._cuse, _OUT.pack(_OUT.size + len(answer), error, unique) + answer)

    def _answer_ioctl(self, content: bytes) -> bytes:
        _, _, command, argument, in_size, out_size = _IOCTL_IN.unpack_from(content)
        data = content[_IOCTL_IN.size :][:in_size]
        if command == _I2C_FUNCS:
            if not out_size:
                return _ask_again([], [(argument, 8)])
            functions = fcntl.ioctl(self._bus, _I2C_FUNCS, bytes(8))
            return _IOCTL_OUT.pack(0, 0, 0, 0) + functions
        if command != _I2C_RDWR:
            return _IOCTL_OUT.pack(0, 0, 0, 0)
        # Pointers of the caller are followed step by step: the kernel copies what is asked for.
        needed = [(argument, _RDWR.size)]
        if not data:
            return _ask_again(needed, [])
        address, count = _RDWR.unpack_from(data)
        needed.append((address, count * _MESSAGE.size))
        if len(data) == _RDWR.size:
            return _ask_again(needed, [])
        messages = list(_MESSAGE.iter_unpack(data[_RDWR.size :][: count * _MESSAGE.size]))
        reads = [(buffer, size) for _, flags, size, buffer in messages if flags & _READ]
        needed += [(buffer, size) for _, flags, size, buffer in messages if not flags & _READ]
        if len(data) < sum(size for _, size in needed) or out_size < sum(size for _, size in reads):
            return _ask_again(needed, reads)
        written = data[_RDWR.size + count * _MESSAGE.size :]
        fault = FAULT.read_text().strip() if FAULT.exists() else ""
        if fault == "short":
            return _IOCTL_OUT.pack(count - 1, 0, 0, 0)
        if fault:
            raise OSError(getattr(errno, fault), fault)
        done, read = self._transfer(messages, written)
        return _IOCTL_OUT.pack(done, 0, 0, 0) + read

    def _transfer(
        self, messages: list[tuple[int, int, int, int]], written: bytes
    ) -> tuple[int, bytes]:
        """Pass the messages on to the other bus."""
        buffers = []
        packed = b""
        for address, flags, size, _ in messages:
            buffer = ctypes.create_string_buffer(size)
            if not flags & _READ:
                buffer.raw, written = written[:size], written[size:]
            buffers.append(buffer)
            packed += _MESSAGE.pack(address, flags, size, ctypes.addressof(buffer))
        array = ctypes.create_string_buffer(packed, len(packed))
        asked = _RDWR.pack(ctypes.addressof(array), len(messages))
        done = fcntl.ioctl(self._bus, _I2C_RDWR, bytearray(asked))
        read = [b.raw for b, m in zip(buffers, messages, strict=True) if m[1] & _READ]
        return done, b"".join(read)


def _ask_again(ins: list[tuple[int, int]], outs: list[tuple[int, int]]) -> bytes:
    """Ask for the same ioctl with this memory of the caller, to read and to write."""
    pieces = b"".join(struct.pack("<QQ", *piece) for piece in (*ins, *outs))
    return _IOCTL_OUT.pack(0, _RETRY, len(ins), len(outs)) + pieces


if __name__ == "__main__":
    CuseBus(sys.argv[1]).serve()
