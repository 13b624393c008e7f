"""The Environment Composition document that the project starts from runs here with only its import lines changed.

The document itself is not part of this repository: its folder is ``../shared/seeds``, or ``$SIM2REAL_SEEDS``. Where an
example cannot run by itself, its test adds exactly what is missing and says so.
"""

import os
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from seed_examples import EXAMPLES

SEEDS = Path(os.environ.get("SIM2REAL_SEEDS", Path(__file__).parents[3] / "shared" / "seeds"))
DOCUMENT = sorted(SEEDS.glob("000_*.txt"))
IMPORTS = {
    "from dm_control import composer": "from sim2real import composer",
    "from dm_control import mjcf": "from sim2real.composer import mjcf",
}
ROBOT = """
<mujoco model="robot">
  <worldbody><body name="arm"><joint name="a" axis="0 1 0"/><joint name="b" axis="1 0 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/><site name="robot_hand" pos="0 0 .3"/></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/></actuator>
</mujoco>
"""
# MuJoCo 3.3.7 to 3.17 say 0 of accelerometers that are fixed to the world, 4 what any of them says at rest.
FELT_AT_REST = [0, 0, 0 if mujoco.__version__ < "4" else 9.81]


def run(code, namespace=None):
    """Execute an example; only its imports are changed."""
    for theirs, ours in IMPORTS.items():
        code = code.replace(theirs, ours)
    namespace = {} if namespace is None else namespace
    exec(compile(code, "seed", "exec"), namespace)
    return namespace


@pytest.mark.skipif(not DOCUMENT, reason=f"no composition document in {SEEDS} (set SIM2REAL_SEEDS)")
def test_the_examples_are_those_of_the_document():
    text = DOCUMENT[0].read_text(encoding="utf-8").split("## Usage Examples")[1]
    found = re.findall(r"### ([^\n]+)\n\s*```python\n(.*?)```", text, flags=re.DOTALL)
    assert {heading: code.split() for heading, code in found} == {k: v.split() for k, v in EXAMPLES.items()}


def test_creating_custom_environments():
    # Missing in the example: the site that the reward measures from. The constructor compiles the world, so it is
    # added before the environment is made.
    code = EXAMPLES["Creating Custom Environments"]
    missing = "arena.mjcf_model.worldbody.add('site', name='hand_site', pos=[0, 0, 1])\n"
    made = run(code.replace("task = ReachTask(", missing + "task = ReachTask("))
    env = made["env"]
    first = env.reset()
    np.testing.assert_array_equal(first.observation["target_position_obs"][0], env.task.target_position)
    step = env.step(np.zeros(0))
    distance = np.linalg.norm([0, 0, 1] - env.task.target_position)
    assert step.reward == pytest.approx(np.exp(-distance))
    steps = 1
    while not step.last():
        step, steps = env.step(np.zeros(0)), steps + 1
    assert steps == 5000  # 10 s at 2 ms


@pytest.fixture
def composed(tmp_path):
    # Missing in the example: the file that it names, and the imports of the example before.
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT, encoding="utf-8")
    imports = "from dm_control import composer\nfrom dm_control import mjcf\n"
    return run(imports + EXAMPLES["Entity Composition"].replace("/path/to/robot.xml", str(path)))


def test_entity_composition(composed):
    composer, robot, ball = composed["composer"], composed["robot"], composed["ball"]
    # Missing in the example: a world that the two entities stand in.
    arena = composer.Arena()
    arena.add_entity(robot)
    arena.add_free_entity(ball)
    env = composer.Environment(composer.NullTask(arena))
    observation = env.reset().observation
    np.testing.assert_array_equal(observation["robot/joint_pos"], np.zeros((1, 2)))
    np.testing.assert_array_equal(observation["position"], np.zeros((1, 3)))
    for _ in range(10):
        observation = env.step([0.1, 0.0]).observation
    assert observation["position"][0, 2] < 0
    assert observation["robot/joint_pos"][0, 0] > 0


def test_advanced_task_design(composed):
    # Missing in the example: the imports, robots and targets, and a world for them; `Environment(arena=)` makes it.
    imports = "import numpy as np\nfrom dm_control import composer\n"
    made = run(imports + EXAMPLES["Advanced Task Design"])
    composer, robot = composed["composer"], composed["robot"]
    arena = composer.Arena()
    arena.add_entity(robot)
    task = made["MultiObjectiveTask"]([robot], [np.array([0.0, 0.0, 0.3])])
    env = composer.Environment(task=task, arena=arena)
    env.reset()
    step = env.step([1.0, -1.0])
    data = env.physics.data
    distance = np.linalg.norm(env.physics.named.data.site_xpos["robot_hand"] - [0, 0, 0.3])
    expected = 1.0 * np.exp(-distance) - 0.5 * 0.1 * 2.0 - 0.2 * 0.01 * np.sum(data.qvel**2)
    assert step.reward == pytest.approx(expected)
    assert step.observation["objective_values"][0, 0] == pytest.approx(expected)


def test_observable_management():
    # Missing in the example: the imports, the site that the sensors sit on, and that the entity is in the task's
    # world. All are added right after the lines that make the entity and the task.
    code = "from dm_control import composer\n" + EXAMPLES["Observable Management"]
    site = "sensor_entity.mjcf_model.worldbody.add('site', name='sensor_site')\n"
    code = code.replace(
        "task = composer.NullTask()\n", f"task = composer.NullTask()\n{site}task.root_entity.attach(sensor_entity)\n"
    )
    made = run(code)
    np.testing.assert_allclose(made["accel_obs"], [FELT_AT_REST])
    np.testing.assert_array_equal(made["gyro_obs"], np.zeros((1, 3)))
    assert made["sensor_entity"].sensor_site.name == "sensor_site"
    assert "unnamed_model/acceleration" in made["time_step"].observation
