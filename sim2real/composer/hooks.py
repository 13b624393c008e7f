"""Runs hooks in order: the task's, then the entities', depth first, then extra ones."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, TypeVar

from sim2real.composer.entity import Entity
from sim2real.composer.task import Task
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim2real.composer.types import Hook
    from sim2real.types import PyTree

T = TypeVar("T")

HOOK_NAMES = (
    "initialize_episode_mjcf",
    "after_compile",
    "initialize_episode",
    "before_step",
    "before_substep",
    "after_substep",
    "after_step",
)
WITH_ACTION = ("before_step", "before_substep")
"""Hooks that get the action, for the task and for extra hooks."""


class Hooks:
    """The hooks of a task and its entities; hooks that no class overrides do not run."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._labels = {name: f"{type(task).__name__}.{name}" for name in HOOK_NAMES}
        self._entity_hooks: dict[str, list[tuple[str, Hook]]] = {}
        self._extra: dict[str, list[Hook]] = {name: [] for name in HOOK_NAMES}
        self.refresh()

    def refresh(self) -> None:
        """Collect the hooks of the entities that are attached now."""
        entities = list(self._task.iter_entities())
        for name in HOOK_NAMES:
            wrap = _with_action if name in WITH_ACTION else _as_it_is
            owners = [e for e in entities if _overrides(e, Entity, name)]
            self._entity_hooks[name] = [(f"{type(e).__name__}.{name}", wrap(getattr(e, name))) for e in owners]

    def add(self, name: str, hook: Hook) -> None:
        """Run a function after the hooks of the task and the entities.

        Raises:
            UsageError: There is no such hook, or ``hook`` is no function.
        """
        if name not in HOOK_NAMES:
            raise UsageError(f"{name!r} is not a valid hook name. Available: {', '.join(HOOK_NAMES)}")
        if not callable(hook):
            raise UsageError(f"{hook!r} is not a callable")
        self._extra[name].append(hook)

    def run(self, name: str, *args: PyTree) -> None:
        """Run all hooks with a name, with the arguments of the task's hook."""
        self.call(self._labels[name], getattr(self._task, name), *args)
        for label, hook in self._entity_hooks[name]:
            self.call(label, hook, *args)
        for hook in self._extra[name]:
            self.call(name, hook, *args)

    def judge(self, physics: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        """Return the task's reward, its discount, and whether it ends the episode, after a control step."""
        task, name = self._task, type(self._task).__name__
        asked = ("get_reward", "get_discount", "should_terminate_episode")
        reward, discount, ends = (self.call(f"{name}.{what}", getattr(task, what), physics) for what in asked)
        return reward, discount, ends

    def call(self, label: str, function: Callable[..., T], *args: PyTree) -> T:
        """Call a function; ``label`` names it in errors."""
        del label
        return function(*args)


def _overrides(owner: Task | Entity, base: type, name: str) -> bool:
    """Return whether an object overrides a hook, in its class or as an attribute."""
    return name in vars(owner) or getattr(type(owner), name, None) is not getattr(base, name)


def _as_it_is(hook: Hook) -> Hook:
    return hook


def _with_action(hook: Hook) -> Hook:
    """Return an entity's hook as a function of physics, action and randomness; most hooks take no action."""
    try:
        parameters = inspect.signature(hook).parameters.values()
    except (TypeError, ValueError):
        parameters = ()
    named = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(named) >= 3:
        return hook
    return lambda physics, action, random_state: hook(physics, random_state)
