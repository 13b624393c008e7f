"""Programs that continuous integration installs, and that other machines may lack."""

import os

import pytest


def need(found: object, program: str) -> None:
    """Skip the test where a program is not installed; where ``CI`` is set, as on GitHub, fail it."""
    if not found:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{program} is not installed")
