"""dm_control's own library of entities, arenas and tasks, loaded with nothing but its import lines changed.

``ported.locomotion.walkers.ant`` is ``dm_control.locomotion.walkers.ant`` on ``sim2real.composer``.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import re
import sys
from pathlib import Path

_IMPORT = re.compile(r"^(\s*)(from|import) (dm_control\S*)( import .*)?$", re.MULTILINE)
_MOVED = {
    "dm_control.composer": "sim2real.composer",
    "dm_control.mjcf": "sim2real.composer.mjcf",
    "dm_control.locomotion": "ported.locomotion",
    "dm_control.entities": "ported.entities",
}
_MEMBERS = {"composer": "sim2real", "mjcf": "sim2real.composer", "locomotion": "ported", "entities": "ported"}


def _moved(match):
    space, word, module, names = match[1], match[2], match[3], match[4] or ""
    if module == "dm_control":
        module = _MEMBERS.get(names.removeprefix(" import ").split(" ")[0], module)
    for old, new in _MOVED.items():
        if module == old or module.startswith(f"{old}."):
            module = new + module[len(old) :]
    return f"{space}{word} {module}{names}"


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname):
        return compile(_IMPORT.sub(_moved, Path(self.path).read_text(encoding="utf-8")), self.path, "exec")


class Finder(importlib.abc.MetaPathFinder):
    """Finds the modules of ``ported``; a context manager that installs itself."""

    def __init__(self, folder):
        self._folder = Path(folder)

    def __enter__(self):
        sys.meta_path.insert(0, self)

    def __exit__(self, *error):
        sys.meta_path.remove(self)
        for name in [n for n in sys.modules if n.split(".")[0] == "ported"]:
            del sys.modules[name]

    def find_spec(self, fullname, path=None, target=None):
        first, *rest = fullname.split(".")
        where = self._folder.joinpath(*rest)
        if first != "ported":
            return None
        if not rest:
            return importlib.machinery.ModuleSpec(fullname, None, is_package=True)
        file = where / "__init__.py" if where.is_dir() else where.with_suffix(".py")
        return importlib.util.spec_from_file_location(
            fullname,
            file,
            loader=_Loader(fullname, str(file)),
            submodule_search_locations=[str(where)] if where.is_dir() else None,
        )
