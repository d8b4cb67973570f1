"""Errors that FootTile raises on purpose.

FootTileError
     +-- SceneError            (ValueError)    a scene file is wrong; exit code 2
     +-- UsageError            (ValueError)    a command's options do not fit together; exit code 2
     |    +-- MissingExtraError                the installation lacks a required package
     +-- LoadTraceError        (ValueError)    a load trace cannot be pressed on the tiles
     +-- I2cError              (OSError)
     |    +-- NoAcknowledgeError               no answer at an address
     |    +-- BusFaultError                    the bus itself failed: time-out, arbitration, reset
     |    |    +-- BusLostError                the adapter went away: unplugged, driver unbound
     |    +-- BusMisuseError                   the adapter cannot do this transfer: our bug
     |    +-- BusSetupError                    no such bus, no permission
     +-- TileSetupError                        a tile's chip is absent or implausible
     +-- SpiError              (OSError)       a transfer over SPI failed
     |    +-- SpiSetupError                    no such SPI device, no permission
     |    +-- AdcSilentError                   no converter drives the line
     +-- ServoError
     |    +-- ServoSetupError                  another servo or another firmware than the scene's
     |    |    +-- ServoLostError              its serial port is not there, or may not be used
     |    +-- ServoTimeoutError (TimeoutError) a servo did not answer in time
     |    +-- ServoPacketError  (ValueError)   bytes that are no valid packet
     |    +-- ServoStatusError                 the servo answered with an error number
     +-- FileFormatError       (ValueError)    a file is absent, unreadable or of another kind
     |    +-- DamagedFileError                 a file's hash does not match
     |    +-- DamagedFramesError               frames on disk do not match their checksum
     +-- StorageError          (OSError)       a file cannot be written or read: disk full, not ours
     |    +-- FolderGoneError                  the folder was moved, deleted or unmounted
     +-- CalibrationError      (ValueError)    a calibration is absent, unphysical or does not fit
     +-- TareError             (ValueError)    no interval to tare on
     +-- ComparisonError       (ValueError)    a reference cannot be compared with a session
     +-- LinkError             (ConnectionError) node, server or client cannot talk to each other
     +-- StateError                            not now: recording already, node away, not sealed
     |    +-- WorkerLostError                  processes that worked on a task were killed
     +-- UnknownError          (LookupError)   no such node, session, tare

Every error has four facts: `what` happened, `where`, the `expected` state, and the `remedy`. Many
errors are also a built-in type, so that callers can catch that. In a running stream a fault is a
flag and a NaN (see `devices.frames`); these errors stop a command, never a stream.

`require_extra` guards the import of optional packages.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Literal, TypedDict, Unpack


def is_utf8_encodable(text: str) -> bool:
    """Return whether a text can be encoded as UTF-8. The names of some files cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def escape_control_chars(text: str, *, keep_line_breaks: bool = False) -> str:
    r"""Escape control characters, so that a terminal prints the text and UTF-8 can encode it.

    Unprintable characters become escapes: `\x1b`, `\u202e`. A byte of a file name that is not UTF-8
    is a lone surrogate in Python: it becomes `\udcff`.

    Args:
        text: untrusted text.
        keep_line_breaks: keep line breaks, tabs and runs of spaces; else join all to one line.
    """
    if not keep_line_breaks:
        text = " ".join(text.split())
    elif text.isascii() and text.replace("\n", "").isprintable():
        return text
    kept = "\n\t" if keep_line_breaks else ""
    return "".join(
        c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text
    )


Extra = Literal[
    "server", "client", "emulation", "discovery", "tls", "plot",
    "gpio", "rig", "archive", "mocap", "mcap", "bridges", "video",
]  # fmt: skip  # two lines, not twelve

_WITHOUT_ARM_WHEELS: dict[Extra, str] = {"mocap": "ezc3d"}
"""Package of an extra that has wheels for x86 only."""
OUR_PACKAGES = ("devices", "storage", "service", "studies", "foottile")


@contextmanager
def require_extra(extra: Extra, feature: str, *, remedy: str = "") -> Iterator[None]:
    """Turn a failed import of an optional package into an error that names its extra.

    Use as a `with` block around the imports, or as the decorator of a function.

    Args:
        extra: extra of `pyproject.toml` that installs the packages.
        feature: feature that needs the packages; the error's text begins with it.
        remedy: remedy, instead of the command that installs the extra.

    Raises:
        MissingExtraError: a package is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in OUR_PACKAGES:  # our own bug, not a missing package
            raise
        raise MissingExtraError(
            f"{feature} needs {package}, which is not installed",
            remedy=remedy or _describe_installation(extra),
        ) from error


def _describe_installation(extra: Extra) -> str:
    command = f"pip install 'foottile[{extra}]'"
    package = _WITHOUT_ARM_WHEELS.get(extra)
    if package is None or not platform.machine().startswith(("aarch", "arm")):
        return f"Install it: {command}"
    return (
        f"{package} has no wheel for ARM: pull the session to a PC, and write the file there, "
        f"after {command}; or build {package} from its source"
    )


class _ErrorFacts(TypedDict, total=False):
    where: str
    expected: str
    remedy: str


class FootTileError(Exception):
    """Base class of all errors. Its text is composed of its facts and safe to print.

    `exit_code` is the exit code of the command line (1 failed, 2 usage).
    """

    exit_code = 1
    fact_names: ClassVar[tuple[str, ...]] = ("what", "where", "expected", "remedy")

    def __init__(self, what: str, *, where: str = "", expected: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.expected = expected
        self.remedy = remedy

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        if self.expected:
            text += f"; expected {self.expected}"
        if self.remedy:
            text += f"{'' if text.endswith(('.', '?', '!')) else '.'} {self.remedy}"
        return escape_control_chars(text)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments must survive pickling between processes.
        return (_rebuild, (type(self), self.to_dict()))

    def to_dict(self) -> dict[str, object]:
        """Return the facts of this error by name."""
        return {name: getattr(self, name) for name in self.fact_names}


def _rebuild(kind: type[FootTileError], facts: dict[str, str]) -> FootTileError:
    return kind(facts.pop("what"), **facts)


class _SystemError(FootTileError, OSError):
    """Error of the operating system; `errno` is its number, or None."""

    fact_names = (*FootTileError.fact_names, "errno")

    def __init__(
        self, what: str, *, errno: int | None = None, **facts: Unpack[_ErrorFacts]
    ) -> None:
        super().__init__(what, **facts)
        self.errno = errno


class SceneError(FootTileError, ValueError):
    """A scene file is unreadable, has an unknown key, a wrong type or contradicts itself."""

    exit_code = 2


class UsageError(FootTileError, ValueError):
    """Options of a command do not fit together or name something that is not there."""

    exit_code = 2


class MissingExtraError(UsageError):
    """The installation lacks a package that the command needs; an extra installs it."""


class LoadTraceError(FootTileError, ValueError):
    """A load trace is unreadable or cannot be pressed on this array."""


class I2cError(_SystemError):
    """A transfer on the I2C bus failed; `errno` is the adapter's (hardware.md 3.2, 3.3)."""


class NoAcknowledgeError(I2cError):
    """Address or data was not acknowledged (EREMOTEIO on a Pi, ENXIO on i2c-gpio)."""


class BusFaultError(I2cError):
    """The bus failed, not one device: ETIMEDOUT, EAGAIN (arbitration), EBUSY, EIO."""


class BusLostError(BusFaultError):
    """The adapter of an open bus went away (ENODEV, ENOENT, ESHUTDOWN and the like)."""


class BusMisuseError(I2cError):
    """The adapter refused the shape of the transfer (EINVAL, EOPNOTSUPP): a bug in the driver."""


class BusSetupError(I2cError):
    """The bus cannot be opened: ENOENT, ENODEV, EACCES."""


class TileSetupError(FootTileError):
    """A tile does not answer at start-up, or is no chip of its kind."""


class SpiError(FootTileError, OSError):
    """A transfer over SPI failed."""


class SpiSetupError(SpiError):
    """The SPI device cannot be opened, or the library for it is not installed."""


class AdcSilentError(SpiError):
    """The null bit before a conversion's result is not low: no converter drives the line."""


class ServoError(FootTileError):
    """Base of the servo's errors."""


class ServoSetupError(ServoError):
    """The servo does not match the scene: another model, firmware or baud rate."""


class ServoLostError(ServoSetupError):
    """The servo's serial port is not there, failed, or may not be used now."""


class ServoTimeoutError(ServoError, TimeoutError):
    """The servo did not answer in time."""


class ServoPacketError(ServoError, ValueError):
    """Bytes on the line are no valid packet: header, length or CRC."""


class ServoStatusError(ServoError):
    """The servo answered with an error number in its status packet."""


class FileFormatError(FootTileError, ValueError):
    """A file is absent, unreadable, or not of the kind the command needs."""


class DamagedFileError(FileFormatError):
    """A file's hash does not match, or it is no regular file."""


class OtherVersionError(FileFormatError):
    """A derived file has the columns of another version and must be made again."""


class DamagedFramesError(FileFormatError):
    """Frames `seq_first` to `seq_last` on disk do not agree with their checksum."""

    fact_names = (*FootTileError.fact_names, "seq_first", "seq_last")

    def __init__(
        self, what: str, *, seq_first: int = 0, seq_last: int = 0, **facts: Unpack[_ErrorFacts]
    ) -> None:
        super().__init__(what, **facts)
        self.seq_first = seq_first
        self.seq_last = seq_last


class StorageError(_SystemError):
    """A file cannot be written or read, although its content is not the cause.

    The disk is full, read-only, or gone; the file is another user's; memory or descriptors are used
    up. `errno` is the system's.
    """


class FolderGoneError(StorageError):
    """A folder was moved, deleted or unmounted while a process writes in it."""


class CalibrationError(FootTileError, ValueError):
    """A calibration is absent, unphysical, or does not cover the array's tiles."""


class TareError(FootTileError, ValueError):
    """No unloaded interval to tare on."""


class ComparisonError(FootTileError, ValueError):
    """A reference cannot be compared with a session: they do not overlap, fit, or bear load."""


class LinkError(FootTileError, ConnectionError):
    """The other end of a link is away, refuses, or does not speak the protocol."""


class StateError(FootTileError):
    """The request does not fit the present state: recording already, node away."""


class ChangedError(StateError):
    """Another client changed the resource in the meantime."""


class WorkerLostError(StateError):
    """The processes that worked on a task were killed repeatedly."""


class UnknownError(FootTileError, LookupError):
    """There is no node, session or tare of that name."""
