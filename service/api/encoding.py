"""Which answers go over the wire compressed: the page's files, and bins of a session as JSON.

The others do not. The length of a compressed answer tells someone who chooses a part of it about
the rest (BREACH, CVE-2013-3587): files of the page are the same for everyone, and bins are numbers,
of which no part comes from a request, while answers with names and notes stay as they are. Parquet
is compressed already.
"""

from __future__ import annotations


def takes_gzip(accept_encoding: str) -> bool:
    """Whether a request's Accept-Encoding names gzip, and not with a weight of nothing."""
    for one in accept_encoding.lower().replace(" ", "").split(","):
        coding, _, weight = one.partition(";q=")
        if coding == "gzip":
            return not weight or weight.strip("0.") != ""
    return False
