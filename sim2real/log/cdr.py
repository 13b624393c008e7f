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
        dtype: Type of the elements.
        shape: ``()`` for a scalar.
        code: The element type's code in the module ``struct``.
        python_type: The Python type whose numbers ``struct`` encodes without loss, if they are in range.
    """

    name: str
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...] = ()
    code: str = field(init=False)
    python_type: type | None = field(init=False)

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
        object.__setattr__(self, "python_type", {"i": int, "u": int, "f": float, "b": bool}[dtype.kind])

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


class Layout:
    """The byte layout of a message type.

    ``pack`` encodes one message; ``np.frombuffer(data, layout.dtype)`` decodes any number of adjacent ones.

    Attributes:
        fields: The fields among the parts, in the order of the values of ``pack``.
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
            # A Python number of the field's type needs no array.
            plain = not part.shape and type(value) is part.python_type
            arguments[slot] = value if plain else _encoded(part, value)
        try:
            return self._struct.pack(*arguments)
        except (struct.error, OverflowError):
            for part, value in zip(self.fields, values, strict=True):
                _encoded(part, value)  # `_encoded` raises an error that names the field
            raise


def _encoded(part: CdrField, value: npt.ArrayLike) -> object:
    """Return a value as `struct` takes it: the bytes of an array, or a scalar."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError) as error:
        raise Sim2RealError(f"field {part.name!r} is {part.dtype.name}, got {value!r}") from error
    if array.shape != part.shape:
        raise Sim2RealError(f"field {part.name!r} has shape {array.shape}, expected {part.shape}")
    if array.dtype != part.dtype:
        array = _converted(part, array)
    return array.tobytes() if part.shape else array.item()


def _converted(part: CdrField, array: np.ndarray) -> np.ndarray:
    """Return an array in a field's type; only floats are rounded."""
    from_kind, to_kind = array.dtype.kind, part.dtype.kind
    if from_kind not in ("biuf" if to_kind == "f" else "biu"):
        raise Sim2RealError(f"field {part.name!r} is {part.dtype.name}, got {array.dtype.name}")
    with np.errstate(over="ignore"):
        result = array.astype(part.dtype)
    if from_kind == "f":
        lost = np.isinf(result) & ~np.isinf(array)
    elif to_kind == "f":
        exact = 1 << (53 if part.code == "d" else 24)  # larger integers are not all exact
        lost = (array > exact) | (array < -exact) if from_kind != "b" else np.zeros(array.shape, bool)
        if lost.any():
            lost = np.reshape([int(r) != int(a) for r, a in zip(result.flat, array.flat, strict=True)], array.shape)
    else:
        lost = result != array
    if lost.any():
        value = array[lost].flat[0] if array.shape else array[()]
        raise Sim2RealError(
            f"field {part.name!r} is {part.dtype.name}, which cannot hold {value!s}",
            hint="give the node's init_output the dtype of its outputs",
        )
    return result
