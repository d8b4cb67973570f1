"""Encoders of elements of a .mat file of version 5: scipy's, and streaming ones for large elements.

scipy writes a struct at once. Here its fields are encoded one after the other, so that one field is
in memory at a time. The head of the struct is scipy's head of a struct with empty fields, with the
length replaced (MAT-File Format, "Level 5 MAT-File Format", mxSTRUCT_CLASS).
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from storage.schema import Array

_NUMBERS: Mapping[str, tuple[int, int]] = {
    "f8": (6, 9),
    "f4": (7, 7),
    "i1": (8, 1),
    "u1": (9, 2),
    "i2": (10, 3),
    "u2": (11, 4),
    "i4": (12, 5),
    "u4": (13, 6),
    "i8": (14, 12),
    "u8": (15, 13),
}
"""Class of array and type of data by numpy type, from MathWorks' "MAT-File Format"."""
_MATRIX, _FLAGS, _SIZE, _NAME = 14, 6, 5, 1
"""Types of elements, from the same tables."""
HEADER_BYTES = 128
"""Length of a file's header; variables follow."""
BYTES_MAX = 2**31 - 1
"""Limit of a variable's length in MATLAB."""
_MATRIX_HEAD = 56
"""Length of the head of a matrix without a name: tag, flags, size, name, tag of the numbers."""
_EMPTY = np.empty((0, 0))


def saved(variables: Mapping[str, object]) -> bytes:
    """Return a file of these variables, encoded by scipy."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, dict(variables), long_field_names=True, oned_as="column")
    content: bytes = file.getvalue()
    return content


def variable(name: str, value: object) -> bytes:
    """Return an encoded variable, without the file's header."""
    return saved({name: value})[HEADER_BYTES:]


def matrix(
    name: str, shape: tuple[int, int], class_: npt.DTypeLike, pieces: Iterable[Array]
) -> Iterator[bytes]:
    """Yield an encoded variable of numbers while `pieces` is read.

    Args:
        name: name of the variable.
        shape: numbers of rows and columns.
        class_: numpy type of the numbers.
        pieces: arrays of this type, column after column.
    """
    kind = np.dtype(class_)
    of_class, of_data = _NUMBERS[kind.str[1:]]
    size = shape[0] * shape[1] * kind.itemsize
    text = name.encode("ascii")
    head = b"".join(
        (
            struct.pack("<IIII", _FLAGS, 8, of_class, 0),
            struct.pack("<IIii", _SIZE, 8, *shape),
            struct.pack("<II", _NAME, len(text)) + text + bytes(-len(text) % 8),
            struct.pack("<II", of_data, size),
        )
    )
    yield struct.pack("<II", _MATRIX, len(head) + size + -size % 8) + head
    for piece in pieces:
        yield piece.tobytes()
    yield bytes(-size % 8)


@dataclass(frozen=True)
class Field:
    """Field of a struct.

    Attributes:
        size: length of its element in bytes.
        make: function that encodes the element.
    """

    size: int
    make: Callable[[], bytes]

    @classmethod
    def of(cls, value: object) -> Field:
        """Return a field whose small value is encoded now."""
        content = _element(value)
        return cls(len(content), lambda: content)

    @classmethod
    def matrix(
        cls, shape: tuple[int, int], class_: npt.DTypeLike, make: Callable[[], object]
    ) -> Field:
        """Return a field of numbers of this shape and class, computed by `make` when written."""
        size = shape[0] * shape[1] * np.dtype(class_).itemsize
        in_tag = size <= 4  # up to 4 bytes are stored in the tag of the numbers
        return cls(_MATRIX_HEAD + (0 if in_tag else -(-size // 8) * 8), lambda: _element(make()))


def struct_array(name: str, elements: Sequence[Mapping[str, Field]]) -> Iterator[bytes]:
    """Yield an encoded array of structs; each has the fields of all, missing ones are empty.

    Args:
        name: name of the variable.
        elements: fields of each struct by name.
    """
    names = list(dict.fromkeys(key for element in elements for key in element))
    plain = np.empty((1, len(elements)), dtype=[(key, object) for key in names])
    for key in names:
        for i in range(len(elements)):
            plain[key][0, i] = _EMPTY
    head = bytearray(variable(name, plain))
    del head[len(head) - _MATRIX_HEAD * plain.size * len(names) :]
    nothing = Field.of(_EMPTY)
    fields = [element.get(key, nothing) for element in elements for key in names]
    struct.pack_into("<I", head, 4, len(head) - 8 + sum(field.size for field in fields))
    yield bytes(head)
    for field in fields:
        content = field.make()
        if len(content) != field.size:
            raise RuntimeError(f"{len(content)} bytes of a field, and not {field.size}")
        yield content


def struct_bytes(elements: Sequence[Mapping[str, Field]]) -> int:
    """Return the approximate length of an array of these structs in bytes."""
    return sum(field.size for element in elements for field in element.values())


def _element(value: object) -> bytes:
    """Return a value encoded as in a struct, without a name."""
    empty = len(variable("s", {"f": _EMPTY})) - _MATRIX_HEAD
    return variable("s", {"f": value})[empty:]
