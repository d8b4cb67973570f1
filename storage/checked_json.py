"""A JSON object that carries a hash of its own text as its last key, so that an edit is seen.

Any program reads it as JSON; one that does not know the key may drop it.
"""

from __future__ import annotations

import hashlib
import re

CHECK = "check"
_END = re.compile(rb',\n "check": "([0-9a-f]{64})"\n\}\Z')


def with_check(text: bytes) -> bytes:
    """The object with its hash as the last key.

    Args:
        text: a JSON object with at least one key, and without this one.
    """
    body = text.rstrip().removesuffix(b"}").rstrip()
    digits = hashlib.sha256(body).hexdigest()
    return body + b',\n "check": "' + digits.encode() + b'"\n}'


def without_check(text: bytes) -> bytes:
    """The object without its hash; the same bytes if it carries none."""
    end = _END.search(text)
    return text if end is None else text[: end.start()] + b"\n}"


def is_unchanged(text: bytes) -> bool | None:
    """Has the text the hash that it states? None if it states none."""
    end = _END.search(text)
    if end is None:
        return None
    return hashlib.sha256(text[: end.start()]).hexdigest().encode() == end[1]
