"""Refusal of Novel's pedar insoles: a force needs the area of each sensor.

The areas differ by sensor and by size. They are in the insole's file, not in the `.asc` file that
the software saves.
"""

from __future__ import annotations

import re
from typing import NoReturn

from devices.errors import FileFormatError

_HEAD = re.compile(r"^sensor type:.*\n(?:.*\n){0,4}pressure values in\s+(\w+)", re.MULTILINE)
_NAMES = re.compile(r"^time\[secs\][ \t]+1[ \t].*$", re.MULTILINE)


def is_pedar(head: str) -> bool:
    """Return whether a text has the pressures of pedar's sensors."""
    return _HEAD.search(head) is not None and _NAMES.search(head) is not None


def refuse_pedar(text: str, where: str, values_max: int) -> NoReturn:
    """Refuse pressures without areas.

    Raises:
        FileFormatError: always.
    """
    names, unit = _NAMES.search(text), _HEAD.search(text)
    count = len(names[0].split()) - 1 if names else 0
    raise FileFormatError(
        f"it has pressures of {count} sensors in {unit[1] if unit else 'kPa'}, and does not state "
        "their areas: no force follows from them",
        where=where,
        expected="forces, of each foot",
        remedy="Let pedar's software compute the force, and save that as a table",
    )
