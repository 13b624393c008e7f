"""What ``sim2real.composer`` offers, wherever in it that is written."""

import importlib
import inspect

import pytest

MODULES = [
    "arena", "define", "entity", "environment", "initializer", "robot", "task", "mjcf.element",
    "observation.observable.base", "observation.updater",
    *(f"variation.{name}" for name in (
        "base", "deterministic", "distributions", "noises", "variators",
    )),
]  # fmt: skip
"""Modules that dm_control has under these names too: what is written for it imports from them."""


@pytest.mark.parametrize("name", MODULES)
def test_modules_are_where_dm_control_has_them(name):
    importlib.import_module(f"sim2real.composer.{name}")


def _parameters(function):
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    return [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]


SHARED = [
    "composer", "composer.observation", "composer.observation.observable", "composer.variation",
    *(f"composer.variation.{name}" for name in ("distributions", "noises", "deterministic")),
]  # fmt: skip


@pytest.mark.parametrize("name", SHARED)
def test_arguments_have_the_places_that_they_have_in_dm_control(oracle, name):
    theirs = importlib.import_module(f"dm_control.{name}")
    ours = importlib.import_module(f"sim2real.{name}")
    for shared in set(dir(theirs)) & set(dir(ours)) - {"cached_property", "observable", "EpisodeInitializationError"}:
        one, other = getattr(theirs, shared), getattr(ours, shared)
        pairs = {shared: (one, other)} if callable(one) and not shared.startswith("_") else {}
        if inspect.isclass(one):
            pairs = {k: (getattr(one, k), getattr(other, k, None)) for k in vars(one) if k[0] != "_" or k == "__init__"}
        for called, (function, twin) in pairs.items():
            expected = _parameters(function)
            if twin is not None and expected:
                assert _parameters(twin)[: len(expected)] == expected, f"{shared}.{called}"
