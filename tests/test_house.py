"""The order of the house: a room imports only from rooms above it; no module is longer than a reader can hold."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sim2real"
ROOMS = [
    "graph", "runtime", "policy", "composer", "worlds", "hardware", "log", "artifacts", "identify", "train", "robots",
    "view", "stages", "cli",
]  # fmt: skip
EVERYWHERE = {"errors", "room"}
STAGES = {"record", "identify", "train", "deploy", "check"}
MAX_LINES = 400
MODULES = sorted(PACKAGE.rglob("*.py"))


def room_of(module: Path) -> str:
    parts = module.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


def imported_rooms(source: str, folder: tuple[str, ...]) -> set[str]:
    """Return the rooms that a module imports from, anywhere in it: inside functions and for type checkers too.

    ``folder`` is the module's folder inside the package; relative imports start there.
    """
    package = ("sim2real", *folder)
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            origin = ".".join([*base, *([node.module] if node.module else [])])
            # `from sim2real import log` names the room behind the import.
            names += [f"{origin}.{a.name}" for a in node.names] if origin == "sim2real" else [origin]
    parts = [name.split(".") for name in names]
    return {p[1] for p in parts if p[0] == "sim2real" and len(p) > 1}


def test_the_house_has_no_other_rooms():
    assert {room_of(module) for module in MODULES} - {""} <= {*ROOMS, *EVERYWHERE}


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(PACKAGE)))
def test_a_room_imports_only_from_rooms_above(module):
    room = room_of(module)
    if room == "":
        return  # the public names: imported lazily, from everywhere
    above = set() if room in EVERYWHERE else set(ROOMS[: ROOMS.index(room) + 1])
    found = imported_rooms(module.read_text(encoding="utf-8"), module.relative_to(PACKAGE).parent.parts)
    below = found - above - EVERYWHERE
    assert not below, f"{module.relative_to(PACKAGE)} imports from {sorted(below)}, which {room} must not know"


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(PACKAGE)))
def test_no_stage_knows_another(module):
    """Each is a function from artifacts to an artifact."""
    parts = module.relative_to(PACKAGE).with_suffix("").parts
    if parts[0] != "stages" or parts[-1] not in STAGES:
        return
    found = set()
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module == "sim2real.stages":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sim2real.stages."):
            found.add(str(node.module).split(".")[2])
    assert not found & (STAGES - {parts[-1]})


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(PACKAGE)))
def test_modules_stay_short(module):
    assert len(module.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize(
    ("source", "rooms"),
    [
        ("from sim2real import train", {"train"}),
        ("import sim2real.view.page", {"view"}),
        ("from ..graph import base", {"graph"}),
        ("from . import reader", {"log"}),
        ("def f():\n    from sim2real.stages.targets import find_run", {"stages"}),
        ("import numpy", set()),
    ],
)
def test_every_kind_of_import_is_seen(source, rooms):
    assert imported_rooms(source, ("log",)) == rooms
