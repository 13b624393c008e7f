"""Control steps of a task, with a camera and without, against dm_control's and against MuJoCo's renderer alone.

Each runs in its own thread, as dm_control assumes that its OpenGL context is always current in its thread.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from benches.rows import Row, medians, row

LINKS = 6
SIZE = 48, 64


def kit(package: str) -> Any:
    """Return the composer and the models of ``sim2real`` or ``dm_control``."""
    models = "sim2real.composer.mjcf" if package == "sim2real" else "dm_control.mjcf"
    return SimpleNamespace(
        composer=importlib.import_module(f"{package}.composer"),
        mjcf=importlib.import_module(models),
        observable=importlib.import_module(f"{package}.composer.observation.observable"),
    )


def kits() -> dict[str, Any]:
    """Return ours and, where it is installed, dm_control's."""
    packages = ("sim2real", "dm_control")
    return {p: kit(p) for p in packages if importlib.util.find_spec(p)}


def robot(k: Any, links: int = LINKS, collide: bool = True) -> Any:
    """Return a chain of links with a position servo at every joint."""
    root = k.mjcf.RootElement(model="robot")
    body = root.worldbody
    for i in range(links):
        body = body.add("body", name=f"link{i}", pos=[0, 0, 0.2 * (i > 0)])
        axis = [0, 1, 0] if i % 2 else [1, 0, 0]
        body.add("joint", name=f"j{i}", type="hinge", axis=axis, damping=0.05, frictionloss=0.02, armature=0.01)
        touch = {} if collide else {"contype": 0, "conaffinity": 0}
        body.add("geom", name=f"g{i}", type="capsule", fromto=[0, 0, 0, 0, 0, 0.2], size=[0.02], mass=0.2, **touch)
        root.actuator.add("position", name=f"j{i}", joint=f"j{i}", kp=2)
    return k.composer.ModelWrapperEntity(root)


def push(k: Any, camera: bool, shadows: bool = True) -> Any:
    """Return a task with an arm on a floor, four observables, one of them late, hooks and a reward."""
    arm = robot(k)
    joints, tip = arm.mjcf_model.find_all("joint"), arm.mjcf_model.find("body", f"link{LINKS - 1}")
    actuators = arm.mjcf_model.find_all("actuator")
    gyro = arm.mjcf_model.sensor.add("gyro", site=tip.add("site", name="tip"))

    class Push(k.composer.Task):
        """Move the tip of the arm with little effort."""

        def __init__(self) -> None:
            self._arena, self._effort = k.composer.Arena(), 0.0
            model = self._arena.mjcf_model
            model.option.noslip_iterations = 0
            model.worldbody.add("geom", type="plane", size=[2, 2, 0.1])
            model.worldbody.add("light", pos=[0, 0, 4])
            eye = model.worldbody.add("camera", pos=[0, -2, 1], xyaxes=[1, 0, 0, 0, 0.4, 1])
            if not shadows:
                model.visual.quality.shadowsize = 0
            self._arena.attach(arm)
            feature, add = k.observable.MJCFFeature, arm.observables.add_observable
            add("angles", feature("qpos", joints, delay=3, buffer_size=2))
            add("speeds", feature("qvel", joints))
            add("gyro", feature("sensordata", gyro, update_interval=2, buffer_size=4, aggregator="mean"))
            add("tip", feature("xpos", tip))
            if camera:
                add("eye", k.observable.MJCFCamera(eye, height=SIZE[0], width=SIZE[1]))
            self.set_timesteps(0.02, 0.004)

        @property
        def root_entity(self) -> Any:
            return self._arena

        def initialize_episode(self, physics: Any, random_state: Any) -> None:
            physics.bind(joints).qpos = random_state.uniform(-0.1, 0.1, LINKS)
            self._effort = 0.0

        def after_substep(self, physics: Any, random_state: Any) -> None:
            self._effort += np.abs(physics.bind(joints).qvel * physics.bind(actuators).force).sum()

        def get_reward(self, physics: Any) -> Any:
            return physics.bind(tip).xpos[2] - 0.01 * self._effort

    return Push()


class Apart:
    """Steps of the task, or images of its start with ``mujoco.Renderer``, in a thread of their own."""

    def __init__(self, package: str, camera: bool, shadows: bool) -> None:
        self._package, self._thread = package, ThreadPoolExecutor(1)
        self._thread.submit(self._start, camera, shadows).result()

    def _start(self, camera: bool, shadows: bool) -> None:
        k = kit("sim2real" if self._package == "mujoco" else self._package)
        env = self._env = k.composer.Environment(push(k, camera, shadows), random_state=0)
        if self._package != "mujoco":
            env.reset()
            self._once = lambda: env.step(np.full(LINKS, 0.3))
            return
        data, renderer = env.physics.data.ptr, mujoco.Renderer(env.physics.model.ptr, *SIZE)
        renderer.update_scene(data, 0)
        self._once, self._renderer = renderer.render, renderer

    def run(self, count: int) -> None:
        """Step, or draw, in a row."""
        self._thread.submit(lambda: [self._once() for _ in range(count)]).result()

    def close(self) -> None:
        """Let go of the graphics device."""
        free = self._renderer.close if self._package == "mujoco" else self._env.physics.free
        self._thread.submit(free).result()
        self._thread.shutdown()


def step(repeats: int, steps_in_a_row: int) -> list[Row]:
    """Return how long control steps of a task take, in processor time: with a camera as well, where there is OpenGL."""
    rows = []
    for name, count, camera, shadows, goal in (
        ("step", steps_in_a_row, False, True, ">= 1.3"),
        ("camera", max(1, steps_in_a_row // 40), True, True, ">= 1.2"),
        ("camera_without_shadows", max(1, steps_in_a_row // 10), True, False, ">= 1.2"),
    ):
        try:
            threads = {p: Apart(p, camera, shadows) for p in (*kits(), *(["mujoco"] if camera else []))}
        except (mujoco.FatalError, ImportError, RuntimeError) as error:
            print(f"no images here: {error}", file=sys.stderr)
            break  # a second attempt would end the process
        programs: dict[str, Callable[[], Any]] = {p: lambda one=one, n=count: one.run(n) for p, one in threads.items()}
        ms = {p: 1e3 * s / count for p, s in medians(programs, repeats, time.process_time).items()}
        for one in threads.values():
            one.close()
        about = "a control step of five physics steps, an arm with four observables, processor time"
        about += f", and an image of {SIZE[0]} x {SIZE[1]}" if camera else ""
        rows.append(row(f"compose/{name}_ms", round(ms["sim2real"], 3), "ms", about))
        if "dm_control" in ms:
            over = round(ms["dm_control"] / ms["sim2real"], 2)
            rows.append(
                row(f"compose/{name}/over_dm_control", over, "1", f"dm_control: {ms['dm_control']:.3g} ms", goal)
            )
        if camera:
            alone = "MuJoCo's renderer for the image alone: the lower bound of a step"
            rows.append(row(f"compose/{name}/image_ms", round(ms["mujoco"], 3), "ms", alone))
    return rows
