"""A robot of two servos side by side, each with a weight on a rod: MJX compiles it in seconds."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import composer
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.robots.messages import EpisodeStart, Goals
from sim2real.robots.robot import Robot
from sim2real.robots.servo.datasheet import DataSheet
from sim2real.robots.servo.drive import JointSensor, ServoDrive
from sim2real.robots.servo.model import ComposedModel
from sim2real.robots.servo.observation import ServoAgent
from sim2real.robots.servo.parts import GoalTask, Servo, ServoDriven
from sim2real.robots.servo.servos import Servos
from sim2real.robots.servo.task import Aim, AimTask, uniform

SHEET = DataSheet(stall=1.4, damping=0.2, armature=0.01, friction=0.02, p_gain=1200, profile_rad_s=2.0)

VALUES = {"gain": 4.2, "damping": 0.15, "armature": 0.008, "friction_left": 0.03, "friction_right": 0.01}


class Pair(ServoDriven):
    def _build(self, sheet, joints, name="pair"):
        self.mjcf_model.model = name
        self.servos = tuple(Servo(joint, (0.0, 1.0, 0.0), sheet) for joint in joints)
        for servo, y, mass in zip(self.servos, (-0.1, 0.1), (0.05, 0.1), strict=True):
            servo.joint.parent.add("inertial", pos=(0, 0, -0.1), mass=mass, diaginertia=[1e-4] * 3)
            self.attach(servo, self.mjcf_model.worldbody.add("site", name=f"at_{servo.name}", pos=(0, y, 0)))


class PairTask(GoalTask):
    """Stay at 0."""

    def __init__(self, joints=("left", "right"), **sheet):
        self.robot, self._arena = Pair(replace(SHEET, **sheet), joints), composer.Arena("stand")
        option = self._arena.mjcf_model.option
        option.integrator, option.flag.contact = "implicitfast", "disable"
        option.iterations, option.ls_iterations = 4, 8
        self._arena.attach(self.robot)
        self.set_timesteps(control_timestep=0.01, physics_timestep=0.005)

    @property
    def root_entity(self):
        return self._arena

    def get_reward(self, physics):
        return -physics.np.sum(physics.bind(self.joints).qpos ** 2)


SERVOS = Servos(("left", "right"), (1, 2), (-1.0, -0.5), (0.8, 1.2), SHEET, speed=2.0)
ANGLE = Aim((("angle", "rad"),), lambda key: uniform(key, [-0.4], [0.8]))


class PairRobot(Robot):
    """Shows its policy the default features; its aim is one angle, which its model does not have."""

    def __init__(self, servos=SERVOS, make_task=PairTask, aim=ANGLE, features=None, observe=None, history=2):
        self.sensor = JointSensor(servos)
        self.drive = ServoDrive(servos)
        self.agent = ServoAgent(servos, aim, features, observe, history)
        self.model = ComposedModel(servos, make_task, aim)
        self.task = AimTask(servos, aim, success, score)


def success(state):
    return jnp.all(jnp.abs(state.data.qpos) < 0.1)


def score(t_s, states):
    return {"success": float(abs(states["position[0]"][-1]) < 0.1)}


def world_params(robot, values, position, velocity, aim):
    """Return the parameters of a robot's world."""
    return robot.model.params(values, EpisodeStart(position, velocity, aim))


def play_on_c(robot, params, goals):
    """Play goals ``(T, n)`` of every tick on C MuJoCo; return the environment, and positions, speeds and rewards."""
    task = robot.model.make_task()
    env = composer.Environment(task)
    env.reset()
    physics, joints = env.physics, env.physics.bind(task.joints)
    for name, (elements, attribute) in robot.model.fields(task).items():
        setattr(physics.bind(elements), attribute, np.asarray(params.values[name]))
    joints.qpos, joints.qvel = np.asarray(params.qpos), np.asarray(params.qvel)
    physics.recompute_constants()
    physics.forward()
    task.robot.initialize_episode(physics, None)
    rows = []
    for goal in goals:
        reward = env.step(np.asarray(goal, np.float64)).reward
        # MuJoCo's speeds are those of half a step ago.
        rows.append([*joints.qpos, *(joints.qvel + 0.5 * task.physics_timestep * joints.qacc), reward])
    rows, n = np.array(rows), len(robot.drive.servos.joints)
    return env, rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n]


def play_in_a_graph(world):
    """Return a compiled program: parameters, goals ``(T, n)`` of every tick -> the first message, all later ones, and
    the references and rewards after each.
    """

    def heard(goal):
        none = jnp.zeros(1)
        return {"actuator": InputState(jnp.zeros(1, jnp.int32), none, none, Goals(goal[None]))}

    def run(params, goals):
        def step(state, goal):
            after, message = world.step(StepState(state=state, params=params, inputs=heard(goal)))
            return after.state, (message, after.state.variables["reference"], after.state.reward)

        gs = GraphState(params={world.name: params})
        gs = gs.replace(state={world.name: world.init_state(jax.random.key(0), gs)})
        return world.init_output(None, gs), *jax.lax.scan(step, gs.state[world.name], goals)[1]

    return jax.jit(run)
