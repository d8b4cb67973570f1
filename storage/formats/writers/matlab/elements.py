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

_NUMBER_TYPES: Mapping[str, tuple[int, int]] = {
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
_MATRIX_HEAD_BYTES = 56
"""Length of the head of a matrix without a name: tag, flags, size, name, tag of the numbers."""
_EMPTY = np.empty((0, 0))


def encode_mat_file(variables: Mapping[str, object]) -> bytes:
    """Return a file of these variables, encoded by scipy."""
    from scipy.io import savemat

    file: Any = io.BytesIO()  # its stubs know names of files only
    savemat(file, dict(variables), long_field_names=True, oned_as="column")
    content: bytes = file.getvalue()
    return content


def encode_mat_variable(name: str, value: object) -> bytes:
    """Return an encoded variable, without the file's header."""
    return encode_mat_file({name: value})[HEADER_BYTES:]


def encode_mat_matrix(
    name: str, shape: tuple[int, int], number_type: npt.DTypeLike, chunks: Iterable[Array]
) -> Iterator[bytes]:
    """Yield an encoded variable of numbers while `pieces` is read.

    Args:
        name: name of the variable.
        shape: numbers of rows and columns.
        number_type: numpy type of the numbers.
        chunks: arrays of this type, column after column.
    """
    kind = np.dtype(number_type)
    of_class, of_data = _NUMBER_TYPES[kind.str[1:]]
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
    for piece in chunks:
        yield piece.tobytes()
    yield bytes(-size % 8)


@dataclass(frozen=True)
class StructField:
    """Field of a struct.

    Attributes:
        size_bytes: length of its element in bytes.
        encode: function that encodes the element.
    """

    size_bytes: int
    encode: Callable[[], bytes]

    @classmethod
    def from_value(cls, value: object) -> StructField:
        """Return a field whose small value is encoded now."""
        content = _encode_element(value)
        return cls(len(content), lambda: content)

    @classmethod
    def from_matrix_function(
        cls,
        shape: tuple[int, int],
        number_type: npt.DTypeLike,
        compute_matrix: Callable[[], object],
    ) -> StructField:
        """Return a field of numbers of this shape and class, computed by `make` when written."""
        size = shape[0] * shape[1] * np.dtype(number_type).itemsize
        in_tag = size <= 4  # up to 4 bytes are stored in the tag of the numbers
        return cls(
            _MATRIX_HEAD_BYTES + (0 if in_tag else -(-size // 8) * 8),
            lambda: _encode_element(compute_matrix()),
        )


def encode_mat_struct_array(
    name: str, structs: Sequence[Mapping[str, StructField]]
) -> Iterator[bytes]:
    """Yield an encoded array of structs; each has the fields of all, missing ones are empty.

    Args:
        name: name of the variable.
        structs: fields of each struct by name.
    """
    names = list(dict.fromkeys(key for element in structs for key in element))
    plain = np.empty((1, len(structs)), dtype=[(key, object) for key in names])
    for key in names:
        for i in range(len(structs)):
            plain[key][0, i] = _EMPTY
    head = bytearray(encode_mat_variable(name, plain))
    del head[len(head) - _MATRIX_HEAD_BYTES * plain.size * len(names) :]
    nothing = StructField.from_value(_EMPTY)
    fields = [element.get(key, nothing) for element in structs for key in names]
    struct.pack_into("<I", head, 4, len(head) - 8 + sum(field.size_bytes for field in fields))
    yield bytes(head)
    for field in fields:
        content = field.encode()
        if len(content) != field.size_bytes:
            raise RuntimeError(f"{len(content)} bytes of a field, and not {field.size_bytes}")
        yield content


def estimate_struct_array_bytes(structs: Sequence[Mapping[str, StructField]]) -> int:
    """Return the approximate length of an array of these structs in bytes."""
    return sum(field.size_bytes for element in structs for field in element.values())


def _encode_element(value: object) -> bytes:
    """Return a value encoded as in a struct, without a name."""
    empty = len(encode_mat_variable("s", {"f": _EMPTY})) - _MATRIX_HEAD_BYTES
    return encode_mat_variable("s", {"f": value})[empty:]
