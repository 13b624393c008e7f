"""The order of hooks over a nested tree of entities."""

import functools

import pytest

from sim2real import composer
from sim2real.composer import mjcf

WITHOUT_PHYSICS = ("initialize_episode_mjcf",)


def noting(calls, who, name, physics, *args):
    calls.append((name, who, len(args) + (name not in WITHOUT_PHYSICS)))


class Noted(composer.Entity):
    def _build(self, name, calls):
        self._model = mjcf.RootElement(model=name)
        self.calls, self.label = calls, name
        for hook in composer.HOOK_NAMES:  # partial functions have no code object
            setattr(self, hook, functools.partial(noting, calls, name, hook))

    @property
    def mjcf_model(self):
        return self._model


class NotedTask(composer.NullTask):
    def __init__(self, root, calls):
        super().__init__(root)
        self.set_timesteps(0.004, 0.002)
        for hook in composer.HOOK_NAMES:
            setattr(self, hook, functools.partial(noting, calls, "task", hook))


@pytest.fixture
def tree():
    """e0(e1(e2), e3), attached from the leaves up."""
    calls = []
    e = [Noted(f"e{i}", calls) for i in range(4)]
    e[1].attach(e[2])
    e[0].attach(e[1])
    e[0].attach(e[3])
    return e, calls


def test_task_then_entities_depth_first_then_extra_hooks(tree):
    entities, calls = tree
    env = composer.Environment(NotedTask(entities[0], calls))
    order = ["task", "e0", "e1", "e2", "e3"]
    assert calls == [("after_compile", who, 2) for who in order]
    calls.clear()
    env.add_extra_hook("before_step", functools.partial(noting, calls, "x", "before_step"))
    env.reset()
    expected = [("initialize_episode_mjcf", 1), ("after_compile", 2), ("initialize_episode", 2)]
    assert [c[:2] for c in calls] == [(name, who) for name, _ in expected for who in order]
    calls.clear()
    env.step([])
    names = ["before_step", *["before_substep", "after_substep"] * 2, "after_step"]
    flat = [(name, who) for name in names for who in order]
    flat.insert(5, ("before_step", "x"))
    assert [c[:2] for c in calls] == flat
    with_action = {(name, who) for name, who, count in calls if count == 3}
    assert with_action == {("before_step", "task"), ("before_step", "x"), ("before_substep", "task")}


def test_new_entities_are_found_and_one_may_ask_for_the_action_too():
    calls, seen = [], []

    class Watcher(composer.Entity):
        def _build(self):
            pass

        def before_step(self, physics, action, random_state):
            seen.append(list(action))

    root = Watcher()
    env = composer.Environment(composer.NullTask(root))
    env.reset()
    env.step([])
    assert seen == [[]]
    root.attach(Noted("late", calls))
    env.reset()
    assert ("initialize_episode", "late", 2) in calls
