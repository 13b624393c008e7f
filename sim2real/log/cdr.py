"""CDR, the encoding of ROS 2 messages, for message types of fixed size.

Plain CDR (XCDR1), little-endian: four bytes of encapsulation, then the fields in order, each aligned to its element
size relative to the first byte after the encapsulation (OMG DDS-XTypes 1.3, section 7.4.1).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import Sim2RealError

if TYPE_CHECKING:
    import numpy.typing as npt

ENCAPSULATION = b"\x00\x01\x00\x00"
# Element type -> its ROS name; below: element type -> its code in `struct`.
ROS_TYPES = {"b1": "bool", "f4": "float32", "f8": "float64"} | {
    f"{kind}{size}": f"{name}{8 * size}" for kind, name in (("i", "int"), ("u", "uint")) for size in (1, 2, 4, 8)
}
_CODES = dict(zip(("b1", "f4", "f8", *(f"{k}{s}" for k in "iu" for s in (1, 2, 4, 8))), "?fdbhiqBHIQ", strict=True))


@dataclass(frozen=True)
class CdrConstant:
    """Bytes that are the same in every message.

    Attributes:
        alignment: Alignment of the bytes [bytes].
    """

    data: bytes
    alignment: int


@dataclass(frozen=True)
class CdrField:
    """A value that differs between messages: a scalar, or an array of fixed shape in row-major order.

    Attributes:
        dtype: Type of its elements.
        shape: ``()`` for a scalar.
        code: The element type's code in the module ``struct``.
    """

    name: str
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...] = ()
    code: str = field(init=False)

    def __post_init__(self) -> None:
        dtype = np.dtype(self.dtype)
        code = _CODES.get(dtype.str[1:])
        if code is None:
            raise Sim2RealError(
                f"field {self.name!r} has dtype {dtype}, which ROS messages cannot hold. "
                f"Available: {', '.join(ROS_TYPES.values())}",
                hint="convert it in the node's output",
            )
        object.__setattr__(self, "dtype", dtype.newbyteorder("<"))
        object.__setattr__(self, "code", code)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=np.int64))


def text(value: str) -> CdrConstant:
    """Return a constant string as a part of a message."""
    data = value.encode() + b"\0"
    return CdrConstant(struct.pack("<I", len(data)) + data, 4)


def length(count: int) -> CdrConstant:
    """Return the element count of a sequence; its elements must follow as further parts."""
    return CdrConstant(struct.pack("<I", count), 4)


def read_text(data: bytes, position: int) -> tuple[str, int]:
    """Return the string at the next aligned position of a message, and the position after the string."""
    position += -(position - len(ENCAPSULATION)) % 4
    (count,) = struct.unpack_from("<I", data, position)
    end = position + 4 + count
    return data[position + 4 : end - 1].decode(), end


class Layout:
    """The byte layout of a message type.

    ``pack`` encodes one message; ``np.frombuffer(data, layout.dtype)`` decodes any number of adjacent ones.

    Attributes:
        fields: The fields among the parts, in the order in which ``pack`` takes their values.
        dtype: A structured dtype of one message, encapsulation included.
        size: Size of a message [bytes].
    """

    def __init__(self, parts: Iterable[CdrConstant | CdrField]) -> None:
        self.fields: list[CdrField] = []
        self._template: list[bytes | None] = [ENCAPSULATION]
        self._slots: list[int] = []
        formats, offsets, position = ["<4s"], [], 0
        for part in parts:
            # Align each part to its element size, relative to the end of the encapsulation.
            padding = -position % (part.alignment if isinstance(part, CdrConstant) else part.dtype.itemsize)
            position += padding
            formats.append(f"{padding}x")
            if isinstance(part, CdrConstant):
                formats.append(f"{len(part.data)}s")
                self._template.append(part.data)
                position += len(part.data)
                continue
            size = part.size * part.dtype.itemsize
            formats.append(f"{size}s" if part.shape else part.code)
            self._slots.append(len(self._template))
            self._template.append(None)
            self.fields.append(part)
            offsets.append(len(ENCAPSULATION) + position)
            position += size
        self._struct = struct.Struct("".join(formats))
        self.size = self._struct.size
        self.dtype = np.dtype(
            {
                "names": [f.name for f in self.fields],
                "formats": [(f.dtype, f.shape) for f in self.fields],
                "offsets": offsets,
                "itemsize": self.size,
            }
        )

    def pack(self, values: Sequence[npt.ArrayLike]) -> bytes:
        """Encode one message.

        Args:
            values: A number or array for each of ``fields``, of the field's shape.

        Raises:
            Sim2RealError: When a value has another shape, or converting it would lose information (a float for an
                integer, a number out of range).
        """
        if len(values) != len(self.fields):
            raise Sim2RealError(
                f"a message has {len(values)} fields, expected {len(self.fields)}: "
                f"{', '.join(f.name for f in self.fields)}"
            )
        arguments: list[object] = list(self._template)
        for slot, part, value in zip(self._slots, self.fields, values, strict=True):
            arguments[slot] = _array_bytes(part, value) if part.shape else value
        try:
            return self._struct.pack(*arguments)
        except (struct.error, TypeError, ValueError) as error:
            raise Sim2RealError(f"{self._culprit(values)}: {error}") from error

    def _culprit(self, values: Sequence[npt.ArrayLike]) -> str:
        """Return a description of the scalar that could not be encoded."""
        for part, value in zip(self.fields, values, strict=True):
            if not part.shape:
                try:
                    struct.pack(f"<{part.code}", value)
                except (struct.error, TypeError, ValueError):
                    shape = getattr(value, "shape", ())
                    return f"field {part.name!r} is {part.dtype.name}, got {value!r} of shape {shape}"
        return "a message cannot be encoded"


def _array_bytes(part: CdrField, value: npt.ArrayLike) -> bytes:
    array = np.asarray(value)
    if array.shape != part.shape:
        raise Sim2RealError(f"field {part.name!r} has shape {array.shape}, expected {part.shape}")
    if array.dtype != part.dtype:
        if not np.can_cast(array.dtype, part.dtype, "same_kind"):
            raise Sim2RealError(f"field {part.name!r} is {part.dtype.name}, got {array.dtype.name}")
        array = array.astype(part.dtype)
    return array.tobytes()
