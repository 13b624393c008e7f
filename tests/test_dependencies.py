"""What pyproject.toml asks for is what the package imports: no more, no less, and extras only where they are named."""

import ast
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {name: packages for name, packages in PROJECT["optional-dependencies"].items() if name not in ("dev", "bench")}
"""Extras for users; ``dev`` and ``bench`` are for the tests and the scripts."""
IMPORTED_AS = {
    "mcap-ros2-support": "mcap_ros2",
    "dm-control": "dm_control", "dm-env": "dm_env", "dynamixel-sdk": "dynamixel_sdk", "mujoco-mjx": "mujoco.mjx",
    "pyserial": "serial", "pyyaml": "yaml", "rerun-sdk": "rerun", "scikit-learn": "sklearn",
}  # fmt: skip
OF_NODES = "distrax"
"""What only the nodes of users import: their delays are distributions of distrax."""
MAY_IMPORT = {
    "view": {"sim2real.view.rerun_recording", "sim2real.view.rerun_viewer", "sim2real.view.model_scene"},
    "hardware": {"sim2real.policy.runner"},
    "interop": {"sim2real.interop.brax", "sim2real.interop.vector"},
    "network": {"sim2real.training.networks.onnx_export"},
    "parquet": {"sim2real.log.importing.lerobot"},
    "unitree": {"sim2real.hardware.unitree.dds", "sim2real.hardware.unitree.messages"},
    "warp": set(),  # MJX imports Warp itself
}
"""Extra -> modules that import its packages. A scene is called by ``view.recording``, which has checked by then."""


def sources() -> dict[str, Path]:
    """Return dotted name -> file of every module that the wheel carries."""
    found = {}
    for folder in ("sim2real", "pipelines"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(source: str, package: str) -> set[str]:
    """Return what a module of a package imports, inside functions too; not what only type checkers read."""
    found: set[str] = set()
    left: list[ast.AST] = [ast.parse(source)]
    while left:
        node = left.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            left += node.orelse
            continue
        left += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            origin = ".".join(part for part in (base, node.module) if part)
            found |= {origin} | {f"{origin}.{alias.name}" for alias in node.names}
    return found


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """Module -> everything that it imports."""
    found = {}
    for name, path in sources().items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        found[name] = imports(path.read_text(encoding="utf-8"), package)
    return found


@pytest.fixture(scope="module")
def reached(imported) -> set[str]:
    """What the command line leads to: its own imports, the stages, which it imports by name, and the pipelines."""
    left = [
        m
        for m in imported
        if m == "sim2real.cli" or m.startswith(("sim2real.stages.", "sim2real.commands.", "pipelines"))
    ]
    found: set[str] = set()
    while left:
        if (module := left.pop()) not in found:
            found.add(module)
            # `import a.b.c` runs a and a.b too.
            names = {name.rsplit(".", n)[0] for name in imported[module] for n in range(name.count(".") + 1)}
            left += names & imported.keys()
    return found


def package_of(requirement: str) -> str:
    """Return the name under which a requirement is imported."""
    name = re.split(r"[^\w.-]", requirement)[0]
    return IMPORTED_AS.get(name, name)


def imports_package(names: set[str], package: str) -> bool:
    return any(name == package or name.startswith(package + ".") for name in names)


def importers(imported: dict[str, set[str]], package: str) -> set[str]:
    return {module for module, names in imported.items() if imports_package(names, package)}


@pytest.mark.parametrize("requirement", [r for r in PROJECT["dependencies"] if not r.startswith(OF_NODES)])
def test_what_a_plain_installation_brings_is_used_by_a_command(requirement, imported, reached):
    assert importers(imported, package_of(requirement)) & reached


def test_what_is_imported_is_declared(imported):
    declared = {package_of(r) for r in sum(EXTRAS.values(), PROJECT["dependencies"])}
    known = {*sys.stdlib_module_names, "sim2real", "pipelines", *(name.partition(".")[0] for name in declared)}
    strangers = {(m, name) for m, names in imported.items() for name in names if name.partition(".")[0] not in known}
    # Suites that plug-ins run in their own tests: who calls them has pytest.
    suites = (".testing", ".conformance")
    assert {(m, name) for m, name in strangers if not (m.endswith(suites) and name == "pytest")} == set()


@pytest.mark.parametrize("extra", EXTRAS)
def test_an_extra_is_imported_only_where_the_error_names_it(extra, imported):
    packages = [package_of(r) for r in EXTRAS[extra] if "mujoco" not in r]
    found = set().union(*(importers(imported, package) for package in packages))
    assert found == MAY_IMPORT[extra]
    named = re.compile(rf"sim2real\[{extra}\]|with_extra\(.{extra}.\)")
    hints = [path for name, path in sources().items() if name in found and named.search(path.read_text())]
    assert hints or not packages
    assert extra == "warp" or re.search(rf"sim2real\[[^]]*\b{extra}\b", str(PROJECT["optional-dependencies"]["dev"]))


def test_mujoco_and_mjx_are_of_one_release():
    """MJX asks for "at least" its own MuJoCo: without the pin pip pairs it with a later one that it does not know."""
    pins = {r.split("==")[1] for r in PROJECT["dependencies"] if r.startswith("mujoco")}
    assert len(pins) == 1
    assert metadata.version("mujoco-mjx") in pins
