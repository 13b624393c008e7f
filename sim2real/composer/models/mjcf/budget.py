"""What a model file may have, counted before MuJoCo reads it, as it would take minutes or gigabytes for more."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from sim2real.errors import UsageError

_MOST_BYTES: Final = 64 * 2**20
"""Of the text of a model and of all files that it includes."""
_MOST_FILE_BYTES: Final = 512 * 2**20
"""Of all meshes, height fields and textures together."""
_MOST_ELEMENTS: Final = 10_000
"""After `replicate`, `composite` and `flexcomp`: MuJoCo reads 10,000 copies in 2.4 s, and 20,000 in four times that."""
_MOST_DEPTH: Final = 200
_MOST_CELLS: Final = 2**24
"""Of a height field, and pixels of a texture."""
_MOST_SIZE: Final = 10_000_000
"""Of any attribute of `size`, and its `memory` in bytes a thousand times that."""
_LIMITS: Final = ("lower", "upper", "effort", "velocity")
"""Attributes of a URDF's limits, which may be infinite."""
_UNITS: Final = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}


class Budget:
    """What a model and the files that it includes may have, counted before MuJoCo reads them."""

    def __init__(self, path: Path, finite: bool = True) -> None:
        """Begin with nothing.

        Args:
            path: The document, for messages and for the files beside it.
            finite: Whether numbers must be finite.
        """
        self._path, self._finite = path, finite
        self._bytes = self._file_bytes = 0
        self._elements = 0
        self._visited: set[Path] = set()
        self._names: set[str] = set()

    def check(self, path: Path) -> None:
        """Count a file.

        Raises:
            UsageError: When it is beyond the budget, or no text in UTF-8.
        """
        if path.resolve() in self._visited or not path.is_file():
            return  # MuJoCo reports the defect
        # Limit the total size of all included files.
        self._visited.add(path.resolve())
        self.add(path.stat().st_size)
        # Read the text; MuJoCo reads UTF-8 without entities.
        try:
            text = path.read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = error.object[: error.start].count(b"\n") + 1
            raise UsageError(
                f"{path} is not UTF-8: byte 0x{error.object[error.start]:02x} in line {line}",
                hint="save it as UTF-8, such as with iconv -f latin1 -t utf-8",
            ) from None
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror}") from None
        self.count(text)

    def add(self, size: int) -> None:
        """Count bytes of text."""
        self._bytes += size
        if self._bytes > _MOST_BYTES:
            self._refuse("has more than", _MOST_BYTES // 2**20, "MiB of text")

    def count(self, text: str) -> None:
        """Count the elements of a text, and the memory that they need."""
        if "<!ENTITY" in text:
            raise UsageError(
                f"{self._path} defines entities, which MuJoCo does not expand", hint="write the text in full"
            )
        # Parse in parts, and stop as soon as a limit is exceeded.
        parser: Any = ET.XMLPullParser(("start", "end"))
        copies = [1]
        try:
            for begin in range(0, len(text), 2**16):
                parser.feed(text[begin : begin + 2**16])
                for event, element in parser.read_events():
                    if event == "end":
                        copies.pop()
                        element.clear()
                        continue
                    copies.append(copies[-1] * _copies(element))
                    self._elements += copies[-1]
                    if len(copies) > _MOST_DEPTH:
                        self._refuse("has elements nested more than", _MOST_DEPTH, "deep")
                    if self._elements > _MOST_ELEMENTS:
                        self._refuse("has more than", _MOST_ELEMENTS, f"elements after <{element.tag}>")
                    self._element(element)
        except ET.ParseError:
            return  # MuJoCo reports the defect

    def _element(self, element: ET.Element) -> None:
        # Refuse numbers that are not finite.
        tag, get = element.tag, element.attrib
        self._names.add(get.get("name", ""))
        for name, value in get.items():
            if self._finite and value not in self._names and any(_strange(word, name) for word in value.split()):
                raise UsageError(f"{self._path}: {name} = {value!r} of a <{tag}> is not finite", hint="correct it")
        # Limit included files, sizes and the memory of files.
        if tag == "include":
            self.check(self._path.parent / get.get("file", ""))
        elif tag == "size":
            for name, value in get.items():
                most = 1000 * _MOST_SIZE if name == "memory" else _MOST_SIZE
                if _number(value) > most:
                    self._refuse(f"asks for {name} = {value} in <size>, more than", most, "")
        elif tag in ("hfield", "texture", "mesh"):
            cells = _number(get.get("nrow")) * _number(get.get("ncol"))
            cells = max(cells, _number(get.get("width")) * _number(get.get("height")))
            if cells > _MOST_CELLS:
                self._refuse(f"has a <{tag}> of more than", _MOST_CELLS, "cells")
            self._file(tag, get)

    def _file(self, tag: str, get: Mapping[str, str]) -> None:
        """Count files that an element names and that lie beside the model or in a folder of it."""
        for name in (get.get("file"), get.get("filename")):
            file = next(iter(self._places(name)), None) if name else None
            if file is None:
                continue
            self._file_bytes += file.stat().st_size
            if self._file_bytes > _MOST_FILE_BYTES:
                self._refuse("names files with more than", _MOST_FILE_BYTES // 2**20, "MiB")
            if math.prod(_png_size(file)) > _MOST_CELLS:
                self._refuse(f"has a <{tag}> of more than", _MOST_CELLS, "pixels")

    def _places(self, name: str) -> Iterable[Path]:
        try:
            return [
                p for p in (self._path.parent / name, *self._path.parent.glob(f"*/{Path(name).name}")) if p.is_file()
            ]
        except (OSError, ValueError, NotImplementedError):
            return []

    def _refuse(self, what: str, most: int, unit: str) -> None:
        raise UsageError(
            f"{self._path} {what} {most} {unit}".rstrip(), hint="take out what the robot's motion does not need"
        )


def _copies(element: ET.Element) -> int:
    """Return the number of copies that MuJoCo makes of an element's content."""
    if element.tag not in ("replicate", "flexcomp", "composite"):
        return 1
    return max(1, math.prod(int(_number(n)) for n in element.attrib.get("count", "1").split()))


def _strange(word: str, name: str) -> bool:
    """Return whether a word of an attribute is a number that is not finite; an infinite end of a range is no limit."""
    word = word.lower().lstrip("+-")
    return word == "nan" or (word in ("inf", "infinity") and not name.endswith("range") and name not in _LIMITS)


def _number(text: str | None) -> float:
    """Return the number of an attribute; 0 where it is none, a large one where it is infinite."""
    text = (text or "").strip()
    factor = _UNITS.get(text[-1:].upper(), 1)
    try:
        number = factor * float(text[:-1] if factor > 1 else text)
    except ValueError:
        return 0.0
    return 0.0 if math.isnan(number) else min(max(number, 0.0), 1e18)


def _png_size(path: Path) -> tuple[int, int]:
    """Return width and height of a PNG; 0 of other files."""
    with path.open("rb") as file:
        head = file.read(24)
    if not head.startswith(b"\x89PNG"):
        return 0, 0
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
