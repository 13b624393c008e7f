"""Stages on emulated robots in this process and in virtual time: the nodes' threads run, and nobody waits."""

import threading
from contextlib import contextmanager

import pytest
from virtual_clock import VirtualClock

from sim2real.emulation import process
from sim2real.emulation.plant import load_plant
from sim2real.emulation.virtual import VirtualRobot
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.stages.session import episode


class RobotClock(VirtualClock):
    """The robot's clock, for the graph that drives it: time jumps when every thread of the graph waits.

    The robot's time passes too while a thread waits for an answer, as it does on a bus; computing takes no time.
    """

    def __init__(self, robot):
        self._robot, self._caller = robot, threading.current_thread()
        super().__init__()

    def monotonic_ns(self):
        return self._robot.now_ns()

    def taking_part(self):
        names = {t: t.name for t in threading.enumerate()}
        return {t for t, name in names.items() if name.startswith("sim2real:") and "truth" not in name} | {self._caller}

    def _go_to(self, deadline):
        self._robot.sleep(1e-9 * (deadline - self._robot.now_ns()))


@contextmanager
def virtual_stages():
    """Let embedded robots be ones in virtual time: a list, each with `threads`, the clock of its graph."""
    robots = []

    def graph(*arguments, **options):
        robots[-1].threads = RobotClock(robots[-1])
        return AsyncGraph(*arguments, clock=robots[-1].threads, **options)

    def opened(plant, config, plant_args=None, truth_path=None):
        if truth_path is not None:
            truth_path.parent.mkdir(parents=True, exist_ok=True)
        if config.serve.startswith("sim2real.emulation.legs"):
            from sim2real.emulation.virtual_legs import VirtualLegs

            robots.append(VirtualLegs(load_plant(plant, dict(plant_args or {})), config, truth_path))
        else:
            robots.append(VirtualRobot(plant, config, plant_args, truth_path))
        return robots[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "EmbeddedRobot", opened)
        patch.setattr(episode, "AsyncGraph", graph)
        yield robots
    for robot in robots:
        robot.stop()
