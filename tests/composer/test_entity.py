import logging

import numpy as np
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.errors import UsageError

ABOUT_Z = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])


class Ball(composer.Entity):
    def _build(self, name="ball"):
        self._model = mjcf.RootElement(model=name)
        self._model.worldbody.add("geom", type="sphere", size=[0.1])

    @property
    def mjcf_model(self):
        return self._model


@pytest.fixture(params=[True, False], ids=["free", "fixed"])
def placed(request):
    arena, ball = composer.Arena(), Ball()
    frame = arena.add_free_entity(ball) if request.param else arena.attach(ball)
    return mjcf.Physics.from_mjcf_model(arena.mjcf_model), ball, frame, request.param


def test_velocity_is_for_free_entities(placed, caplog):
    physics, ball, _, free = placed
    if not free:
        with pytest.raises(UsageError, match="non-free"):
            ball.get_velocity(physics)
        with caplog.at_level(logging.WARNING):
            ball.set_velocity(physics, [1, 0, 0])
        assert "no free joint" in caplog.text
        return
    ball.set_velocity(physics, [0, 1, 0], [0, 0, 2])
    ball.shift_pose(physics, quaternion=ABOUT_Z, rotate_velocity=True)
    velocity, angular = ball.get_velocity(physics)
    np.testing.assert_allclose(velocity, [-1, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(angular, [0, 0, 2])


def test_a_pose_is_set_in_parts_and_moved(placed):
    physics, ball, _, _ = placed
    ball.set_pose(physics, position=[1, 2, 3])
    ball.set_pose(physics, quaternion=2 * ABOUT_Z)
    ball.shift_pose(physics, position=[0, 0, 1])
    position, quaternion = ball.get_pose(physics)
    np.testing.assert_allclose(position, [1, 2, 4])
    np.testing.assert_allclose(quaternion, ABOUT_Z)
    ball.shift_pose(physics, quaternion=ABOUT_Z)
    position, quaternion = ball.get_pose(physics)
    np.testing.assert_allclose(position, [1, 2, 4])
    np.testing.assert_allclose(quaternion, [0, 0, 0, 1], atol=1e-12)
    physics.forward()
    np.testing.assert_allclose(ball.global_vector_to_local_frame(physics, [1, 2, 3]), [-1, -2, 3], atol=1e-12)
    np.testing.assert_allclose(ball.global_vector_to_local_frame(physics, [1, 2]), [-1, -2], atol=1e-12)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(ball.global_xmat_to_local_frame(physics, turn), turn.T, atol=1e-12)
    np.testing.assert_allclose(ball.global_xmat_to_local_frame(physics, turn.ravel()), turn.T.ravel(), atol=1e-12)
    for wrong in (lambda: ball.global_vector_to_local_frame(physics, [1]),
                  lambda: ball.global_xmat_to_local_frame(physics, np.eye(4))):  # fmt: skip
        with pytest.raises(UsageError, match="should have shape"):
            wrong()
    with pytest.raises(RuntimeError, match="No attachment frame found"):
        Ball().get_pose(physics)


def test_configure_joints_sets_own_joints_and_those_of_childrens_frames():
    arena, ball, door = composer.Arena(), Ball(), Ball("door")
    frame = ball.attach(door)
    frame.add("joint", type="hinge")
    own = arena.add_free_entity(ball)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    ball.configure_joints(physics, [0.3])
    np.testing.assert_array_equal(physics.data.qpos[7:], [0.3])
    np.testing.assert_array_equal(physics.bind(own.find_all("joint", True)).qpos, [0, 0, 0, 1, 0, 0, 0])


def test_robot_needs_actuators_and_has_joints():
    class Arm(composer.Robot):
        def _build(self):
            body = self.mjcf_model.worldbody.add("body")
            body.add("joint", name="a")

        @property
        def actuators(self):
            return self.mjcf_model.find_all("actuator")

    assert [j.name for j in Arm().joints] == ["a"]
    with pytest.raises(TypeError, match="actuators"):
        composer.Robot()


def test_cached_properties_are_computed_once():
    class Part(Ball):
        count = 0

        @composer.cached_property
        def big(self):
            self.count += 1
            return object()

    part = Part()
    assert part.big is part.big
    assert part.count == 1
    with pytest.raises(AttributeError, match="computed"):
        part.big = 3
