"""Which answers go over the wire compressed: the page's files, and numbers of a session as JSON.

The others do not. The length of a compressed answer tells someone who chooses a part of it about
the rest (BREACH, CVE-2013-3587): files of the page are the same for everyone, and of numbers
no part comes from a request, while answers with names and notes stay as they are. Parquet
is compressed already.
"""

from __future__ import annotations

import gzip

_LEVEL = 1
"""Of numbers: less than half of the length in a hundredth of a second; the best takes ten times as
long."""


def takes_gzip(accept_encoding: str) -> bool:
    """Whether a request's Accept-Encoding names gzip, and not with a weight of nothing."""
    for one in accept_encoding.lower().replace(" ", "").split(","):
        coding, _, weight = one.partition(";q=")
        if coding == "gzip":
            return not weight or weight.strip("0.") != ""
    return False


def packed(numbers: bytes) -> bytes:
    """Numbers as gzip, quickly."""
    return gzip.compress(numbers, _LEVEL)
