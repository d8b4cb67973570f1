"""Addresses of servers, as people write them."""

from __future__ import annotations

import re


def decode_zone(url: str) -> str:
    """Return an address whose IPv6 zone is written as sockets take it.

    A URL has `%25` in front of the zone (RFC 6874): `http://[fe80::1%25eth0]:8000`; a socket, `%`.
    """
    return re.sub(r"(?<=\[)[^]]*(?=])", lambda host: host[0].replace("%25", "%"), url, count=1)
