"""The command line in an interpreter that finds nothing of what only the distribution sim2real brings."""

import sys
from importlib.machinery import PathFinder

from sim2real.later import ABSENT


class Finder(PathFinder):
    """Python's own, without these packages."""

    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        absent = any(f"{fullname}.".startswith(f"{package}.") for package in ABSENT)
        return None if absent else super().find_spec(fullname, path, target)


if __name__ == "__main__":
    sys.meta_path[:] = [Finder if finder is PathFinder else finder for finder in sys.meta_path]
    from sim2real import cli

    sys.exit(cli.main(sys.argv[1:]))
