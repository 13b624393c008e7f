"""The two distributions: one at a time, the same packages of the same versions, and numbers drawn without JAX."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from sim2real import installation
from sim2real.errors import NotInstalled, UsageError
from sim2real.installation import with_extra
from sim2real.later import Later

ROOT = Path(__file__).resolve().parent.parent


def project(folder):
    return tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_light_distribution_asks_for_packages_of_the_whole_one():
    whole, light = project("."), project("packaging/robot")
    assert set(light["dependencies"]) < set(whole["dependencies"])
    assert light["scripts"] == whole["scripts"]
    assert light["requires-python"] == whole["requires-python"]
    extras = light["optional-dependencies"]
    assert extras.items() <= whole["optional-dependencies"].items()


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="only a checkout knows which files git ignores")
def test_the_source_distribution_holds_every_file_of_the_checkout():
    """So it can run `make test`: without a list of its own, it has every file that git does not ignore."""
    targets = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    assert "sdist" not in targets
    ignored = ["git", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    assert subprocess.run(ignored, cwd=ROOT, capture_output=True, text=True, check=True).stdout == ""


def test_two_distributions_in_one_folder_are_refused(tmp_path):
    (tmp_path / "sim2real-0.2.0.dist-info").mkdir()
    (tmp_path / "sim2real_other-1.0.dist-info").mkdir()
    installation.require_one(tmp_path)
    (tmp_path / "sim2real_robot-0.2.0.dist-info").mkdir()
    with pytest.raises(UsageError, match="both sim2real and sim2real-robot are installed") as caught:
        installation.require_one(tmp_path)
    assert "pip uninstall -y sim2real sim2real-robot" in str(caught.value.hint)


def test_a_module_is_imported_on_its_first_use(monkeypatch):
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    module = Later("colorsys")
    assert "colorsys" not in sys.modules
    assert module.rgb_to_hsv(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
    assert "colorsys" in sys.modules


def test_an_absent_package_is_named_and_any_other_error_is_its_own(monkeypatch):
    monkeypatch.setitem(sys.modules, "evosax.absent", None)
    with pytest.raises(NotInstalled, match="needs the package evosax, which is not installed"):
        _ = Later("evosax.absent").anything
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        _ = Later("no_such_package").anything


def test_no_page_and_no_hint_installs_a_package_of_this_name():
    """The name is not registered: an index may serve a stranger's package under it."""
    places = ("README.md", "docs/**/*.md", "sim2real/**/*.py", "scripts/**/*.py")
    unsafe = re.compile(r"pip install [^\n`]*['\" ]sim2real(-robot)?['\"\[ `\n]")
    found = [str(p) for place in places for p in ROOT.glob(place) if unsafe.search(p.read_text())]
    assert found == []
    assert "rerun-sdk" in with_extra("view")
    assert with_extra("interop").count("'") == 4
