"""The order of the house: a room imports only from rooms above it; modules stay short; what is public is described."""

import ast
import functools
import graphlib
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sim2real"
ROOMS = [
    "graph", "runtime", "policy", "composer", "worlds", "hardware", "log", "artifacts", "identify", "train", "robots",
    "view", "stages", "interop", "commands", "cli",
]  # fmt: skip
EVERYWHERE = {
    *("arrays", "callable_package", "errors", "installation", "later", "leaps", "plain_pytree", "pytree"),
    *("random_numbers", "types"),
}
STAGES = {path.parent.name for path in (PACKAGE / "stages").glob("*/stage.py")}
COMPOSED = {"latency": {"record", "identify"}, "record": {"check"}}
"""Stages that call other stages: latency records steps and identifies the delay from them, and record checks a motion
from a file before it plays it."""
MOST_FILES = 15
"""Modules in a folder."""
MAX_LINES = 400
MODULES = sorted(PACKAGE.rglob("*.py"))
TWICE = {
    "Robot": {"composer/robot.py", "robots/contract.py"},  # the composer's names are dm_control's
}
"""Public classes of one name."""
LAZY_BELOW = {"composer/__init__.py": {"interop"}}
"""Modules that name rooms below for type checkers, and import from them on first use alone."""


def room_of(module: str) -> str:
    return "" if module == "__init__.py" else module.split("/")[0].removesuffix(".py")


@functools.cache
def sources() -> dict[str, str]:
    """Return the text of every module by its path inside the package."""
    return {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in MODULES}


@functools.cache
def trees() -> dict[str, ast.Module]:
    """Return the syntax tree of every module by its path inside the package; each is parsed once for all tests."""
    return {module: ast.parse(text) for module, text in sources().items()}


def imported_names(tree: ast.Module, folder: tuple[str, ...]) -> set[str]:
    """Return the names that a module imports, also inside functions and for type checkers.

    ``folder`` is the module's folder inside the package; relative imports start there. ``from a import b`` is ``a.b``.
    """
    package = ("sim2real", *folder)
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return the imported names of every module by its path inside the package."""
    return {module: imported_names(tree, tuple(module.split("/")[:-1])) for module, tree in trees().items()}


def rooms_of(names: set[str]) -> set[str]:
    """Return the rooms that imported names belong to."""
    parts = [name.split(".") for name in names]
    return {p[1] for p in parts if p[0] == "sim2real" and len(p) > 1}


def rooms_below(room: str, names: set[str]) -> set[str]:
    """Return the rooms below a module's room that it imports from; the public names import lazily from everywhere."""
    if room == "":
        return set()
    above = set(ROOMS[: ROOMS.index(room) + 1]) if room in ROOMS else set()
    return rooms_of(names) - above - EVERYWHERE


def other_stages(module: str, names: set[str]) -> set[str]:
    """Return the stages that the module of a stage imports; an empty set for every other module."""
    stage = Path(module).parent.name
    if Path(module).name != "stage.py":
        return set()
    parts = [name.split(".") for name in names if re.match(r"sim2real\.stages\.\w+\.stage(\.|$)", name)]
    return {p[2] for p in parts} - {stage} - COMPOSED.get(stage, set())


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Return modules that import each other in a circle; empty where there is none."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def dotted(module: str) -> str:
    return f"sim2real.{module.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__")


def test_no_modules_import_each_other_in_a_circle():
    graph = {dotted(module): set[str]() for module in trees()}
    for module, names in imports().items():
        for name in names:
            known = name if name in graph else name.rpartition(".")[0]
            if known in graph:
                graph[dotted(module)].add(known)
    assert sum(map(len, graph.values())) > len(graph), "imports are found at all"
    assert not (found := circle(graph)), f"each of these modules imports the one before or after it: {found}"


@pytest.mark.parametrize(("graph", "found"), [({"a": {"b"}, "b": {"a"}}, ["a", "b", "a"]), ({"a": {"b"}}, [])])
def test_circles_are_seen(graph, found):
    assert sorted(circle(graph)) == sorted(found)


def test_no_two_modules_of_tests_have_one_name():
    """Pytest imports each by its name alone."""
    paths = sorted(Path(__file__).parent.rglob("test_*.py"))
    twice = [name for name, count in Counter(path.name for path in paths).items() if count > 1]
    assert not twice, f"modules of tests of one name: {[p for p in paths if p.name in twice]}"


def test_the_house_has_no_other_rooms():
    assert {room_of(module) for module in trees()} - {""} <= {*ROOMS, *EVERYWHERE}


def test_a_room_imports_only_from_rooms_above():
    below = {m: rooms_below(room_of(m), names) - LAZY_BELOW.get(m, set()) for m, names in imports().items()}
    wrong = {module: sorted(rooms) for module, rooms in below.items() if rooms}
    assert not wrong, f"modules, and the rooms that they must not know: {wrong}"


@pytest.mark.parametrize(
    ("room", "name", "below"),
    [
        ("log", "sim2real.view.page", {"view"}),
        ("log", "sim2real.graph.base", set()),
        ("errors", "sim2real.graph", {"graph"}),
        ("graph", "sim2real.errors", set()),
        ("", "sim2real.cli", set()),
    ],
)
def test_every_import_from_a_room_below_is_seen(room, name, below):
    assert rooms_below(room, {name}) == below


def test_no_stage_knows_another():
    """Each is a function from artifacts to an artifact."""
    wrong = {module: sorted(stages) for module, names in imports().items() if (stages := other_stages(module, names))}
    assert not wrong, f"stages, and the other stages that they import: {wrong}"
    assert {"record", "identify", "train", "deploy", "check", "validate", "latency"} <= STAGES


def test_no_folder_is_crowded():
    counts = Counter(path.parent.relative_to(PACKAGE).as_posix() for path in MODULES)
    crowded = {folder: n for folder, n in counts.items() if n > MOST_FILES}
    assert not crowded, f"folders with more than {MOST_FILES} modules: {crowded}"


@pytest.mark.parametrize(
    ("module", "source", "stages"),
    [
        ("stages/train/stage.py", "from sim2real.stages.record import stage, config", {"record"}),
        ("stages/train/stage.py", "from sim2real.stages.identify.stage import run", {"identify"}),
        ("stages/train/stage.py", "import sim2real.stages.deploy.stage", {"deploy"}),
        ("stages/train/stage.py", "from ..check import stage", {"check"}),
        ("stages/train/stage.py", "from sim2real.stages.train import resume", set()),
        ("stages/train/stage.py", "from sim2real.stages.record.config import RecordConfig", set()),
        ("stages/latency/stage.py", "from sim2real.stages.record.stage import record", set()),
        ("stages/config.py", "from sim2real.stages.record import stage", set()),
    ],
)
def test_every_import_of_another_stage_is_seen(module, source, stages):
    assert other_stages(module, imported_names(ast.parse(source), ("stages", "train"))) == stages


def test_modules_stay_short():
    long = {module: n for module, text in sources().items() if (n := len(text.splitlines())) > MAX_LINES}
    assert not long, f"modules of more than {MAX_LINES} lines: {long}"


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
    assert rooms_of(imported_names(ast.parse(source), ("log",))) == rooms


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


def misdescribed(tree: ast.Module) -> list[str]:
    """Return the public functions whose Args section names what is no parameter, or is in another order."""
    found = [(name, parameters(node), described(docstring)) for name, node, docstring in public(tree.body)]
    return [name for name, names, entries in found if names and [n for n in names if n in entries] != entries]


def test_no_two_public_classes_have_one_name():
    homes: dict[str, set[str]] = {}
    for module, tree in trees().items():
        for name, node, _ in public(tree.body):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(name, set()).add(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == TWICE


def test_whatever_is_public_has_a_docstring():
    bare = [module for module, tree in trees().items() if not ast.get_docstring(tree)]
    bare += [f"{module}: {name}" for module, tree in trees().items() for name, _, text in public(tree.body) if not text]
    assert not bare, f"no docstring: {bare}"


def test_args_sections_name_parameters_in_their_order():
    wrong = {module: names for module, tree in trees().items() if (names := misdescribed(tree))}
    assert not wrong, f"Args sections that name no parameter, or are in another order: {wrong}"


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("def f(a, b, c): ...", []),
        ('def f(a, b, c):\n    """F.\n\n    Args:\n        a: A.\n        c: C,\n            b: D.\n    """', []),
        ('def f(a, b):\n    """F.\n\n    Args:\n        b: B.\n        a: A.\n    """', ["f"]),
        ('def f(a, b):\n    """F.\n\n    Args:\n        old: B.\n    """', ["f"]),
        (
            'class C:\n    """C.\n\n    Args:\n        b: B.\n        old: C.\n    """\n'
            "    def __init__(self, a, b): ...",
            ["C"],
        ),
    ],
)
def test_every_kind_of_wrong_args_section_is_seen(source, names):
    assert misdescribed(ast.parse(source)) == names
