"""Values and keys in TOML, which the standard library reads and does not write."""

import json
import math
import re

from sim2real.errors import UsageError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_value(value: object) -> str:
    """Return a text, a number, a boolean or a list of them as TOML writes it.

    Raises:
        UsageError: When it is of another type, or a text has half a character, which names of files can have.
    """
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise UsageError(
                f"{value!r} cannot be written: it has bytes that are no text", hint="rename the file or joint"
            ) from None
        # TOML has the escapes of JSON, and needs one for DEL.
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
    """Return a part of a key, quoted if TOML needs quotes."""
    return key if _BARE.fullmatch(key) else toml_value(key)
