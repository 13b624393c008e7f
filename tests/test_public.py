"""What ``import sim2real`` offers, as a notebook and ``help`` show it."""

import importlib
import inspect
import pydoc
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import sim2real

STAGES = ["check", "deploy", "export", "identify", "record", "report", "run", "train", "validate"]


def test_importing_is_cheap_and_the_names_are_those_that_are_public():
    code = "import sim2real, sys; print('jax' in sys.modules, *dir(sim2real))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert said[0] == "False"
    assert set(said[1:]) == {*sim2real.__all__, "interop", "__version__"}
    assert set(STAGES) <= set(said)


@pytest.mark.parametrize("name", STAGES)
def test_help_and_signature_are_those_of_the_function(name):
    function = getattr(sim2real, name)
    assert inspect.isfunction(function)
    first = next(iter(inspect.signature(function).parameters))
    assert first == ("run" if name == "report" else "robot")
    text = pydoc.render_doc(function, renderer=pydoc.plaintext)
    assert f"function {name} in module" in text
    assert "Args:" in text


@pytest.mark.parametrize("room", ["identify"])
def test_a_room_stays_importable_beside_the_function_of_its_name(room):
    """In whatever order: importing a module of a room sets the room as the package's attribute, if nothing keeps it."""
    module = "parameters"
    code = f"""
import sim2real
import sim2real.{room}.{module}
from sim2real.{room} import {module} as found
import sim2real.{room}.{module} as named
assert callable(sim2real.{room}) and named is found is sim2real.{room}.{module}
import sim2real.{room}.config
from sim2real import {room}
assert {room}.config is sim2real.{room}.config
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert isinstance(importlib.import_module(f"sim2real.{room}"), ModuleType)
    assert not isinstance(getattr(sim2real, room), ModuleType)


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = sim2real.trian
    assert Path(str(sim2real.__file__)).name == "__init__.py"
