"""Escapes of characters that XML 1.0 does not allow (https://www.w3.org/TR/xml/#charsets)."""

from __future__ import annotations

import re

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def escape_xml_invalid_characters(text: str) -> str:
    r"""Return text with characters that XML does not allow as escapes: `\\ufffe`."""
    return _NOT_IN_XML.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
