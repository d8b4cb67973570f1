"""Addresses of servers as users type them."""

from __future__ import annotations

import re


def decode_zone(url: str) -> str:
    """Return an address with its IPv6 zone in the notation of sockets.

    A URL has `%25` in front of the zone (RFC 6874): `http://[fe80::1%25eth0]:8000`; a socket, `%`.
    """
    return re.sub(r"(?<=\[)[^]]*(?=])", lambda host: host[0].replace("%25", "%"), url, count=1)
