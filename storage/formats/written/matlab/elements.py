"""Elements of a .mat file of version 5, encoded by scipy, and what is too large for that.

scipy writes a struct as a whole. Here its fields follow one another, so that one is in memory at a
time: what stands in front of them is scipy's, of a struct with empty fields, and says how long all
of them are (MAT-File Format, "Level 5 MAT-File Format", mxSTRUCT_CLASS).
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
"""Classes of arrays and types of their data, as MathWorks' "MAT-File Format" numbers them."""
_MATRIX, _FLAGS, _SIZE, _NAME = 14, 6, 5, 1
"""Types of elements, from the same tables."""
HEADER_BYTES = 128
"""Of a file; variables follow."""
BYTES_MAX = 2**31 - 1
"""Of one variable, as MATLAB reads it."""
_MATRIX_HEAD = 56
"""Of a matrix without a name: its tag, flags, size, name, and the tag of its numbers."""
_EMPTY = np.empty((0, 0))


def saved(variables: Mapping[str, object]) -> bytes:
    """A file of these variables, as scipy writes it."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, dict(variables), long_field_names=True, oned_as="column")
    content: bytes = file.getvalue()
    return content


def variable(name: str, value: object) -> bytes:
    """A variable as it stands in a file, behind the header."""
    return saved({name: value})[HEADER_BYTES:]


def matrix(
    name: str, shape: tuple[int, int], class_: npt.DTypeLike, pieces: Iterable[Array]
) -> Iterator[bytes]:
    """A variable of numbers, given away as they come.

    Args:
        name: of the variable.
        shape: rows and columns.
        class_: of the numbers.
        pieces: these numbers, column after column.
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
    """A field of one struct of the array.

    Attributes:
        size: of its element, in bytes.
        make: gives the element.
    """

    size: int
    make: Callable[[], bytes]

    @classmethod
    def of(cls, value: object) -> Field:
        """One that is small enough to be kept."""
        content = _element(value)
        return cls(len(content), lambda: content)

    @classmethod
    def matrix(
        cls, shape: tuple[int, int], class_: npt.DTypeLike, make: Callable[[], object]
    ) -> Field:
        """Numbers of this shape and class, made when they are due."""
        size = shape[0] * shape[1] * np.dtype(class_).itemsize
        in_tag = size <= 4  # so few stand in the tag of the numbers
        return cls(_MATRIX_HEAD + (0 if in_tag else -(-size // 8) * 8), lambda: _element(make()))


def struct_array(name: str, elements: Sequence[Mapping[str, Field]]) -> Iterator[bytes]:
    """A variable: a row of structs, each with the fields of all; those that it has not are empty.

    Args:
        name: of the variable.
        elements: by name, the fields of each struct.
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
    """About as many bytes has a variable of these structs."""
    return sum(field.size for element in elements for field in element.values())


def _element(value: object) -> bytes:
    """A value as it stands in a struct: without a name."""
    empty = len(variable("s", {"f": _EMPTY})) - _MATRIX_HEAD
    return variable("s", {"f": value})[empty:]
