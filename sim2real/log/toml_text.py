"""Values and keys as TOML writes them; the standard library only reads TOML."""

from __future__ import annotations

import json
import math
import re

from sim2real.errors import UsageError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_value(value: object) -> str:
    """Return a text, a number, a boolean or a list of them as TOML writes it.

    Raises:
        UsageError: When it is none of them, or a text has half a character, as names of files may.
    """
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise UsageError(
                f"{value!r} cannot be written: it has bytes that are no text", hint="rename what has this name"
            ) from None
        # TOML has JSON's escapes, but none for half of a character, and it wants DEL escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    raise UsageError(f"{value!r} has no form in TOML")


def toml_key(key: str) -> str:
    """Return a part of a key: as it is where TOML takes that, else quoted."""
    return key if _BARE.fullmatch(key) else toml_value(key)
