"""Vitals of a machine: disk, heat, supply, load, Wi-Fi, clock; and warnings with remedies.

Read from Linux and, on a Raspberry Pi, from its firmware. A value that the machine lacks is None.
The bits of `get_throttled` are those of the Raspberry Pi's documentation (`vcgencmd`).
"""

from __future__ import annotations

import math
import os
import re
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field

from devices.realtime import read_clock_state
from devices.types import Count, StrictModel

VITALS_INTERVAL_S = 5.0
_CALM_UPDATES = 6
"""Updates without a cause that end a warning, half a minute, so that no warning flickers."""
_COMMAND_TIMEOUT_S = 2.0


class Vitals(StrictModel):
    """Vitals of a node; None: its machine does not state it."""

    disk_free_bytes: Count | None = None
    """Free space in the folder of the journal."""
    recording_left_s: Annotated[float, Field(ge=0)] | None = None
    """Time for which that suffices at the present rate of bytes."""
    cpu_celsius: float | None = None
    is_undervolted: bool | None = None
    """True if the supply of a Raspberry Pi is below 4.63 V now."""
    was_undervolted: bool | None = None
    """True if it was so at any time since the start of the machine."""
    is_throttled: bool | None = None
    """True if the CPU is slowed down now, by heat or by the supply."""
    was_throttled: bool | None = None
    """True if it was so at any time since the start of the machine."""
    load_per_core: Annotated[float, Field(ge=0)] | None = None
    """Runnable tasks per core, mean of a minute."""
    wifi_dbm: float | None = None
    """Signal of the Wi-Fi in use."""
    is_clock_synchronised: bool | None = None
    clock_error_max_s: Annotated[float, Field(ge=0)] | None = None
    """Bound of the clock's error, as the kernel states it."""


def read_vitals(
    journal_folder: Path | None, bytes_per_s: float | None = None, *, root: Path = Path("/")
) -> Vitals:
    """Read the vitals of this machine; it may take seconds on a machine that is in trouble.

    Args:
        journal_folder: folder of the journal, perhaps not created yet; None: no disk.
        bytes_per_s: present rate of the journal.
        root: root of `/proc` and `/sys`.
    """
    free = None
    with suppress(OSError):
        if journal_folder is not None:
            folders = (journal_folder, *journal_folder.parents)
            disk = os.statvfs(next(folder for folder in folders if folder.exists()))
            free = disk.f_bavail * disk.f_frsize
    clock = read_clock_state()
    return Vitals(
        disk_free_bytes=free,
        recording_left_s=free / bytes_per_s if free is not None and bytes_per_s else None,
        cpu_celsius=_read_cpu_celsius(root),
        **_read_supply(root),
        load_per_core=_read_load_per_core(root),
        wifi_dbm=_read_wifi_dbm(root),
        is_clock_synchronised=None if clock is None else clock.is_set,
        clock_error_max_s=None if clock is None else clock.error_max_s,
    )


def _read(path: Path) -> str:
    """Return a small file's text; empty if it cannot be read."""
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def _read_cpu_celsius(root: Path) -> float | None:
    zones = sorted((root / "sys/class/thermal").glob("thermal_zone*"))
    named = [zone for zone in zones if re.search("cpu|soc|x86_pkg", _read(zone / "type"))]
    for zone in named or zones[:1]:
        with suppress(ValueError):
            return int(_read(zone / "temp")) / 1000
    return None


def _read_supply(root: Path) -> dict[str, bool]:
    """Return the facts of the firmware, else of its monitor, which knows only the present."""
    text = _run_vcgencmd(root) or _read(
        root / "sys/devices/platform/soc/soc:firmware/get_throttled"
    )
    if found := re.fullmatch(r"(?:throttled=)?(?:0x)?([0-9a-fA-F]{1,8})", text):
        bits = int(found[1], 16)
        return {
            "is_undervolted": bool(bits & 0x1),
            "is_throttled": bool(bits & 0xE),  # capped, throttled, soft limit of temperature
            "was_undervolted": bool(bits & 0x1_0000),
            "was_throttled": bool(bits & 0xE_0000),
        }
    for monitor in sorted((root / "sys/class/hwmon").glob("hwmon*")):
        alarm = _read(monitor / "in0_lcrit_alarm")
        if _read(monitor / "name") == "rpi_volt" and alarm in ("0", "1"):
            return {"is_undervolted": alarm == "1"}
    return {}


def _run_vcgencmd(root: Path) -> str:
    command = root / "usr/bin/vcgencmd"
    if not command.exists():
        return ""
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(  # noqa: S603  # a fixed path without input
            [command, "get_throttled"],
            capture_output=True,
            check=True,
            encoding="utf-8",
            errors="replace",
            timeout=_COMMAND_TIMEOUT_S,
        ).stdout.strip()
    return ""


def _read_load_per_core(root: Path) -> float | None:
    cores = len(list((root / "sys/devices/system/cpu").glob("cpu[0-9]*")))
    with suppress(ValueError, IndexError, ZeroDivisionError):
        return float(_read(root / "proc/loadavg").split()[0]) / cores
    return None


def _read_wifi_dbm(root: Path) -> float | None:
    """Return the signal of the default route's interface; without a route, of the first one."""
    signals = {}
    for line in _read(root / "proc/net/wireless").splitlines()[2:]:
        name, _, facts = line.partition(":")
        with suppress(ValueError, IndexError):
            signals[name.strip()] = float(facts.split()[2])
    default = []
    for line in _read(root / "proc/net/route").splitlines()[1:]:
        with suppress(ValueError, IndexError):
            route = line.split()
            default += [(int(route[6]), route[0])] if route[1] == "00000000" else []
    found = signals.get(min(default)[1]) if default else next(iter(signals.values()), None)
    return found if found is not None and found < 0 else None  # else no dBm, or no link


_SUPPLY = "use a 5 V 3 A supply and a short cable"


class _Rule(NamedTuple):
    """Rule of a warning; between its thresholds the warning stays as it was.

    Attributes:
        name: field of `Vitals`.
        bad: threshold of the warning.
        good: threshold of its end: below `bad` if high values are bad, else above.
        text: the warning.
    """

    name: str
    bad: float
    good: float
    text: str


_RULES = (
    _Rule(
        *("recording_left_s", 3600, 7200),
        "the journal's disk has room for less than an hour of recording: free space on it",
    ),
    _Rule(
        "cpu_celsius", 80, 75, "the CPU is at 80 °C, where a Raspberry Pi is slowed down: cool it"
    ),
    _Rule("is_undervolted", 1, 0, f"the supply sags below 4.63 V: {_SUPPLY}"),
    _Rule(
        *("was_undervolted", 1, 0),
        f"the supply has sagged below 4.63 V since the machine was started: {_SUPPLY}, and restart",
    ),
    _Rule("is_throttled", 1, 0, f"the CPU is slowed down by heat or supply: cool it, or {_SUPPLY}"),
    _Rule("wifi_dbm", -75, -70, "the Wi-Fi signal is below -75 dBm: bring the access point nearer"),
)


class VitalsWarnings:
    """Warnings about vitals, which begin at once and end after half a minute without a cause."""

    def __init__(self) -> None:
        self._calm_updates: dict[str, int] = {}
        """Updates in a row without a cause, of each present warning."""

    def update(self, vitals: Vitals) -> tuple[str, ...]:
        """Return the present warnings after new vitals; an unknown value ends one, too."""
        calm = self._calm_updates
        for name, bad, good, _ in _RULES:
            value = getattr(vitals, name)
            sign = 1 if good < bad else -1
            level = -math.inf if value is None else sign * value
            if level >= sign * bad:
                calm[name] = 0
            elif name in calm:
                calm[name] = calm[name] + 1 if level <= sign * good else 0
                if calm[name] >= _CALM_UPDATES:
                    del calm[name]
        present = calm.keys() - ({"was_undervolted"} if "is_undervolted" in calm else set())
        return tuple(text for name, _, _, text in _RULES if name in present)
