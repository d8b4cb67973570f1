"""Fast encoder of thousands of messages of equal length from a template and columns.

The template is a message encoded by the format's library; only numbers are replaced in it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from storage.schema import Array


class MessageTemplate:
    """Template of encoded messages whose numbers are replaced.

    Args:
        template: one encoded message.
        fields: numpy type and byte offset of each replaced number, by name.
    """

    def __init__(self, template: bytes, fields: Mapping[str, tuple[str, int]]) -> None:
        self._template = np.frombuffer(template, dtype=np.uint8)
        self._dtype = np.dtype(
            {
                "names": list(fields),
                "formats": [type_ for type_, _ in fields.values()],
                "offsets": [place for _, place in fields.values()],
                "itemsize": len(template),
            }
        )

    def encode_messages(self, values: Mapping[str, Array]) -> list[bytes]:
        """Return n encoded messages.

        Args:
            values: n numbers for each field, by name.
        """
        n, size = len(next(iter(values.values()))), len(self._template)
        content = np.tile(self._template, (n, 1))
        rows = content.view(self._dtype)[:, 0]
        for name in self._dtype.names or ():
            rows[name] = values[name]
            if rows[name].dtype.kind == "f":  # its sign depends on numpy's version and on n
                rows[name][np.isnan(rows[name])] = np.nan
        data = content.tobytes()
        return [data[begin : begin + size] for begin in range(0, n * size, size)]
