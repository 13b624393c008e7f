"""The order of the house: a room imports only from rooms above it; modules stay short; what is public is described."""

import ast
import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sim2real"
ROOMS = [
    "graph", "runtime", "policy", "composer", "worlds", "hardware", "log", "artifacts", "identify", "train", "robots",
    "view", "stages", "interop", "cli",
]  # fmt: skip
EVERYWHERE = {"arrays", "errors", "room"}
STAGES = {"record", "identify", "train", "deploy", "check"}
MAX_LINES = 400
MODULES = sorted(PACKAGE.rglob("*.py"))
MANY = 3
"""From so many parameters on, a public function describes each of them."""
TWICE = {
    "Robot": {"composer/robot.py", "robots/base.py"},  # the composer's names are dm_control's
}
"""Public classes of one name."""


def room_of(module: Path) -> str:
    parts = module.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


def imported_names(source: str, folder: tuple[str, ...]) -> set[str]:
    """Return what a module imports, anywhere in it: inside functions and for type checkers too.

    ``folder`` is the module's folder inside the package; relative imports start there. ``from a import b`` is ``a.b``.
    """
    package = ("sim2real", *folder)
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


def imported_rooms(source: str, folder: tuple[str, ...]) -> set[str]:
    """Return the rooms that a module imports from."""
    parts = [name.split(".") for name in imported_names(source, folder)]
    return {p[1] for p in parts if p[0] == "sim2real" and len(p) > 1}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Return modules that import each other in a circle; empty where there is none."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def dotted(module: Path) -> str:
    return ".".join(module.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def test_no_modules_import_each_other_in_a_circle():
    graph = {dotted(module): set[str]() for module in MODULES}
    for module in MODULES:
        for name in imported_names(module.read_text(encoding="utf-8"), module.relative_to(PACKAGE).parent.parts):
            known = name if name in graph else name.rpartition(".")[0]
            if known in graph:
                graph[dotted(module)].add(known)
    assert not circle(graph)


@pytest.mark.parametrize(("graph", "found"), [({"a": {"b"}, "b": {"a"}}, ["a", "b", "a"]), ({"a": {"b"}}, [])])
def test_circles_are_seen(graph, found):
    assert sorted(circle(graph)) == sorted(found)


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


Documented = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def is_more_of_another(node: Documented) -> bool:
    """Return whether a definition is the setter of a property, or another signature of a function."""
    setter = any(isinstance(d, ast.Attribute) and d.attr == "setter" for d in node.decorator_list)
    return setter or any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, Documented, str]]:
    """Yield dotted name, definition and docstring of the public classes, functions and methods in a body.

    A constructor has the docstring of its class. Nested functions, members of private classes, the setters of
    properties and overloads do not count.
    """
    for node in body:
        if isinstance(node, Documented) and not node.name.startswith("_") and not is_more_of_another(node):
            yield prefix + node.name, node, ast.get_docstring(node) or ""
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public(node.body, f"{prefix}{node.name}.")
            for made in node.body:
                if isinstance(made, ast.FunctionDef) and made.name == "__init__":
                    yield prefix + node.name, made, ast.get_docstring(node) or ""


def parameters(node: Documented) -> list[str]:
    """Return the names of a function's parameters, but for ``self``, ``cls``, ``*args`` and ``**kwargs``."""
    if isinstance(node, ast.ClassDef):
        return []
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [a.arg for a in arguments if a.arg not in ("self", "cls")]


def described(docstring: str) -> list[str]:
    """Return the names in a docstring's Args section."""
    section = re.search(r"^Args:\n((?: .*\n|\n)*)", docstring + "\n", re.MULTILINE)
    return re.findall(r"^    (\w+): ", section[1], re.MULTILINE) if section else []


def undescribed(tree: ast.Module) -> list[str]:
    """Return the public functions with many parameters whose Args section is missing, incomplete or out of date."""
    found = [(name, parameters(node), described(docstring)) for name, node, docstring in public(tree.body)]
    return [name for name, given, told in found if (len(given) >= MANY or (given and told)) and given != told]


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    return {m.relative_to(PACKAGE).as_posix(): ast.parse(m.read_text(encoding="utf-8")) for m in MODULES}


@pytest.fixture(scope="module")
def found(trees) -> dict[str, list[str]]:
    return {module: names for module, tree in trees.items() if (names := undescribed(tree))}


def test_no_two_public_classes_have_one_name(trees):
    homes: dict[str, set[str]] = {}
    for module, tree in trees.items():
        for name, node, _ in public(tree.body):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(name, set()).add(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == TWICE


def test_whatever_is_public_has_a_docstring(trees):
    bare = [module for module, tree in trees.items() if not ast.get_docstring(tree)]
    bare += [f"{module}: {name}" for module, tree in trees.items() for name, _, text in public(tree.body) if not text]
    assert not bare


def test_functions_describe_their_parameters(found):
    assert not found, f"no Args section that names each parameter, in their order: {found}"


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("def f(a, b, c): ...", ["f"]),
        ("def f(a, b, *rest, **options): ...", []),
        ('def f(a, b, c):\n    """F.\n\n    Args:\n        a: A.\n        b: B,\n            d: D.\n'
         '        c: C.\n    """', []),
        ('def f(a, b):\n    """F.\n\n    Args:\n        a: A.\n        old: B.\n    """', ["f"]),
        ("class C:\n    def m(self, a, *, b, c): ...", ["C.m"]),
        ('class C:\n    """C.\n\n    Args:\n        a: A.\n        b: B.\n        c: C.\n    """\n'
         "    def __init__(self, a, b, c): ...", []),
        ("class _C:\n    def m(self, a, b, c): ...", []),
        ("def f():\n    def g(a, b, c): ...", []),
    ],
)  # fmt: skip
def test_every_kind_of_undescribed_function_is_seen(source, names):
    assert undescribed(ast.parse(source)) == names
