"""Worlds from parts against dm_control's composer, MJX against C, and tasks on MJX against bare ``mjx.step``.

The world is 20 robots with six links each, free to fall over one another. Without dm_control its rows are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benches.compose_step import LINKS, kit, kits, robot, step
from benches.compose_warp import warp
from benches.figures import compare, medians, row

PARTS = ("build", "reset", "step", "steps", "engines", "speed", "warp")
ENTITIES = 20
SCENES = {"contact_free": "<= 1e-10", "contacts": "<= 1e-6"}
"""Where MJX is compared with C, and how near it should come."""
QUICK = {
    "repeats": 1,
    "copies": 2,
    "steps": 10,
    "links": 1,
    "control_steps": 2,
    "resets": 1,
    "scenes": ["contact_free"],
    "warp_copies": [2],
    "warp_steps": 2,
}


def world(k: Any, entities: int = ENTITIES) -> Any:
    """Return an arena with a floor and free robots on it."""
    arena = k.composer.Arena()
    arena.mjcf_model.option.noslip_iterations = 0
    arena.mjcf_model.worldbody.add("geom", type="plane", size=[5, 5, 0.1])
    for i in range(entities):
        frame = arena.add_free_entity(robot(k))
        frame.pos = [0.3 * i, 0, 0.3]
    return arena


def build(repeats: int) -> list[dict[str, Any]]:
    """Return how long it takes to build and to compile the world."""
    worlds: dict[str, Any] = {}
    programs: dict[str, Callable[[], Any]] = {}

    def make(name: str, k: Any) -> None:
        worlds[name] = world(k)

    for name, k in kits().items():
        programs[f"{name} build"] = lambda name=name, k=k: make(name, k)
        programs[f"{name} compile"] = lambda name=name, k=k: k.mjcf.Physics.from_mjcf_model(worlds[name].mjcf_model)
    ms = {name: 1e3 * s for name, s in medians(programs, repeats).items()}
    built, compiled = ms["sim2real build"], ms["sim2real compile"]
    rows = [
        row("compose/build_20_entities_ms", round(built + compiled, 2), "ms", "built and compiled"),
        row("compose/compile/build_ms", round(built, 2), "ms", "adding 240 elements and attaching 20 models"),
        row("compose/compile/compile_ms", round(compiled, 2), "ms", "copying, attaching, MuJoCo's compiler, a state"),
    ]
    if "dm_control build" in ms:
        theirs = ms["dm_control build"] + ms["dm_control compile"]
        over = round(theirs / (built + compiled), 1)
        told = f"dm_control: {ms['dm_control build']:.0f} + {ms['dm_control compile']:.0f} ms"
        rows.insert(0, row("compose/build_20_entities/over_dm_control", over, "1", told, ">= 8"))
    return rows


def reset(repeats: int, row_of: int) -> list[dict[str, Any]]:
    """Return how long it takes to start an episode."""
    found = kits()
    programs = {}
    for name, k in found.items():
        for every in (True, False):
            env = k.composer.Environment(
                k.composer.NullTask(world(k)), random_state=0, recompile_mjcf_every_episode=every
            )
            programs[name, every] = lambda env=env: [env.reset() for _ in range(row_of)]
    ms = {key: 1e3 * s / row_of for key, s in medians(programs, repeats).items()}
    rows = []
    for every, name, told in (
        (True, "reset", "recompile_mjcf_every_episode=True, the default"),
        (False, "reset_without_recompiling", "recompile_mjcf_every_episode=False"),
    ):
        mine = ms["sim2real", every]
        rows.append(row(f"compose/{name}_ms", round(mine, 3), "ms", told))
        if "dm_control" in found:
            theirs = ms["dm_control", every]
            text = f"dm_control: {theirs:.3g} ms, {told}" + ("" if every else ": MuJoCo alone takes nearly all of it")
            rows.append(row(f"compose/{name}/over_dm_control", round(theirs / mine, 1), "1", text, ">= 100"))
    return rows


def steps(count: int) -> list[dict[str, Any]]:
    """Return how many steps under random controls end in the same state, bit for bit."""
    both = [k.mjcf.Physics.from_mjcf_model(world(k).mjcf_model) for k in kits().values()]
    if len(both) < 2:
        return []
    rng, equal, contacts = np.random.RandomState(0), 0, 0
    for physics in both:
        with physics.reset_context():
            pass
    for _ in range(count):
        control = rng.uniform(-1, 1, both[0].model.nu)
        for physics in both:
            physics.set_control(control)
            physics.step()
        states = [np.concatenate([p.data.qpos, p.data.qvel, p.data.sensordata, p.data.xpos.ravel()]) for p in both]
        equal += bool(np.array_equal(*states))
        contacts = max(contacts, both[0].data.ncon)
    told = f"dm_control, the same world, up to {contacts} contacts"
    return [row("compose/c_steps_bit_equal", equal, f"of {count}", told, str(count))]


def drop(k: Any) -> Any:
    """Return a task without a reward: a ball that rolls and a capsule that topples on a floor."""
    arena = k.composer.Arena()
    arena.mjcf_model.worldbody.add("geom", type="plane", size=[1, 1, 0.1])
    for i, shape in enumerate((["sphere", [0.1]], ["capsule", [0.05, 0.1]])):
        prop = k.mjcf.RootElement(model=shape[0])
        prop.worldbody.add("geom", type=shape[0], size=shape[1])
        frame = arena.add_free_entity(k.composer.ModelWrapperEntity(prop))
        frame.pos, frame.euler = [0.5 * i, 0, 0.2], [0.3, 0.2, 0]
    return k.composer.NullTask(arena)


def difference(task: Callable[[], Any], controls: np.ndarray) -> tuple[float, int]:
    """Return the largest difference of a state on MJX in float64 from the one on C, and the most contacts."""
    import jax
    import jax.numpy as jnp

    from sim2real import composer

    with jax.enable_x64(True):
        environment = composer.MjxEnvironment(task())

        def play(key: Any, actions: Any) -> Any:
            def step(state: Any, action: Any) -> Any:
                state = environment.step(state, action)
                return state, (state.data.qpos, state.data.qvel)

            return jax.lax.scan(step, environment.reset(key), actions)[1]

        found = jax.jit(play)(jax.random.key(0), jnp.asarray(controls))
        moved = np.concatenate([np.asarray(x) for x in found], axis=1)
    env = composer.Environment(task())
    env.reset()
    worst, contacts = 0.0, 0
    for mine, control in zip(moved, controls, strict=True):
        env.step(control)
        data = env.physics.data
        worst = max(worst, float(np.abs(mine - np.concatenate([data.qpos, data.qvel])).max()))
        contacts = max(contacts, data.ncon)
    return worst, contacts


def engines(length: int, links: int, scenes: Sequence[str]) -> list[dict[str, Any]]:
    """Return how far MJX is from C after 300 steps, or fewer."""
    k, length = kit("sim2real"), min(length, 300)
    controls = {
        "contact_free": np.random.RandomState(0).uniform(-1, 1, (length, links)),
        "contacts": np.zeros((length, 0)),
    }
    tasks = {
        "contact_free": lambda: k.composer.NullTask(robot(k, links, collide=False)),
        "contacts": lambda: drop(k),
    }
    rows = []
    for scene in scenes:
        worst, contacts = difference(tasks[scene], controls[scene])
        told = f"largest difference of qpos and qvel over {length} steps, up to {contacts} contacts"
        goal = SCENES[scene]
        rows.append(row(f"compose/mjx_over_c_float64/{scene}", float(f"{worst:.2g}"), "1", told, goal))
    return rows


def reach(links: int) -> Any:
    """Return a task with what tasks have: an arm, observables of which one is late, a start by chance, a reward."""
    from sim2real import composer
    from sim2real.composer.observation.observable import MJCFFeature

    class Reach(composer.Task):
        """Move the tip of the arm to a place."""

        def __init__(self) -> None:
            arm = robot(kit("sim2real"), links, collide=False)
            self._root_entity, self.joints = arm, arm.mjcf_model.find_all("joint")
            self.tip = arm.mjcf_model.find("body", f"link{links - 1}")
            option = arm.mjcf_model.option
            option.iterations, option.ls_iterations = 4, 4
            self.set_timesteps(0.02, 0.01)
            for name, late in (("qpos", {"delay": 3, "buffer_size": 2}), ("qvel", {})):
                arm.observables.add_observable(name, MJCFFeature(name, self.joints, **late))

        def initialize_episode(self, physics: Any, random_state: Any) -> None:
            physics.bind(self.joints).qpos = random_state.uniform(-0.1, 0.1, links)

        def get_reward(self, physics: Any) -> Any:
            tip = physics.bind(self.tip).xpos
            return physics.np.exp(-physics.np.sum((tip - physics.np.array([0.5, 0.0, 0.5])) ** 2))

        def should_terminate_episode(self, physics: Any) -> Any:
            return physics.bind(self.tip).xpos[2] < -1.0

    return Reach()


def speed(copies: int | None, repeats: int, links: int) -> list[dict[str, Any]]:
    """Return what a task costs over as many bare ``mjx.step`` in the same motion."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    from sim2real import composer

    environment = composer.MjxEnvironment(reach(links), time_limit=10.0)
    model, count = environment.mjx_model, environment.substeps
    device = jax.default_backend()
    copies = copies or (256 if device == "cpu" else 4096)
    length = 10 if device == "cpu" else 50
    times = jnp.arange(length) * 0.02

    def wave(t: Any, q: Any) -> Any:
        return 0.3 * jnp.sin(3.0 * t + jnp.arange(float(links))) - 0.1 * q

    def task(start: Any) -> Any:
        def step(state: Any, t: Any) -> Any:
            state = environment.step(state, wave(t, state.data.qpos))
            seen = sum(x.sum() for x in state.observation.values())
            return state, (state.reward, seen, state.done)

        state, outcome = jax.lax.scan(step, start, times)
        return state.data.qpos.sum(), outcome

    def bare(start: Any) -> Any:
        def step(data: Any, t: Any) -> Any:
            data = data.replace(ctrl=wave(t, data.qpos))
            return jax.lax.scan(lambda d, _: (mjx.step(model, d), None), data, length=count)[0], None

        return jax.lax.scan(step, start.data, times)[0].qpos.sum()

    starts = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(0), copies))
    seconds, compile_s = compare({"bare": bare, "task": task}, starts, repeats)
    print(copies, seconds, file=sys.stderr)
    rate = {name: copies * length / s for name, s in seconds.items()}
    name, told = f"compose/{device}", f"bare mjx.step in the same motion, {copies} copies"
    over = round(seconds["task"] / seconds["bare"], 3)
    return [
        row(f"{name}/mjx_env_over_bare", over, "1", told, "<= 1.15"),
        row(f"{name}/mjx_env_steps_per_s", round(rate["task"]), "1/s", f"{rate['bare']:.3g} bare"),
        row(f"{name}/mjx_compile_s", round(compile_s["task"], 1), "s", f"{compile_s['bare']:.1f} bare"),
    ]


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=1000, help="steps that are compared with dm_control's")
    parser.add_argument(
        "--scenes", nargs="+", choices=SCENES, default=list(SCENES), help="where MJX is compared with C"
    )
    parser.add_argument("--control-steps", type=int, default=200, help="of a task, in a row; fewer with a camera")
    parser.add_argument("--links", type=int, default=LINKS, help="links of the arm on MJX")
    parser.add_argument("--resets", type=int, default=10, help="in a row: one alone would be timed with cold caches")
    parser.add_argument("--copies", type=int, help="copies of the task on MJX; default: 256 on the CPU, 4096 on a GPU")
    parser.add_argument(
        "--warp-copies",
        type=int,
        nargs="+",
        help="of the quadruped on Warp; default: 8 on the CPU, on a GPU three",
    )
    parser.add_argument("--warp-steps", type=int, default=100, help="control steps of the quadruped in a rollout")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Measure; MJX's speed on the device that JAX finds."""
    parts: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "build": lambda: build(3 * options.repeats),
        "reset": lambda: reset(options.repeats, options.resets),
        "step": lambda: step(options.repeats, options.control_steps),
        "steps": lambda: steps(options.steps),
        "engines": lambda: engines(options.steps, options.links, options.scenes),
        "speed": lambda: speed(options.copies, options.repeats, options.links),
        "warp": lambda: warp(options.warp_copies, options.repeats, options.warp_steps),
    }
    return {"rows": [r for name in PARTS if name in options.parts for r in parts[name]()]}
