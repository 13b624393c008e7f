"""What ``import sim2real`` offers, as a notebook and ``help`` show it."""

import inspect
import pydoc
import subprocess
import sys
from pathlib import Path

import pytest

import sim2real

STAGES = ["check", "deploy", "export", "identify", "record", "report", "run", "train", "validate"]


def test_importing_is_cheap_and_the_names_are_those_that_are_public():
    code = "import sim2real, sys; from sim2real import composer; composer.Environment; "
    code += "print('jax' in sys.modules, *dir(sim2real))"
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


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = sim2real.trian
    assert Path(str(sim2real.__file__)).name == "__init__.py"
