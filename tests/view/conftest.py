from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import synthetic_run


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory) -> Path:
    """A run with all four stages; tests that change it take ``run``."""
    return synthetic_run.write_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(finished_run, tmp_path) -> Path:
    """A copy of the run that a test may change."""
    copy = shutil.copytree(finished_run, tmp_path / finished_run.name, ignore=shutil.ignore_patterns("report.html"))
    return Path(copy)


@pytest.fixture
def only(run):
    """Return a function that leaves but some stages in the run: what is not drawn costs no time."""

    def leave(*stages: str) -> Path:
        for folder in run.iterdir():
            if folder.name not in stages:
                shutil.rmtree(folder)
        return run

    return leave
