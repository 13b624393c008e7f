"""The examples of the Environment Composition document, word for word, with the indentation that it lost."""

EXAMPLES = {
    "Creating Custom Environments": """
from dm_control import composer
from dm_control import mjcf
import numpy as np
# Create custom task
class ReachTask(composer.Task):
    def __init__(self, target_position):
        self.target_position = target_position
    def initialize_episode(self, physics, random_state):
        # Randomize target position
        self.target_position = random_state.uniform(-1, 1, size=3)
    def get_reward(self, physics):
        # Simple distance-based reward
        hand_pos = physics.named.data.site_xpos['hand_site']
        distance = np.linalg.norm(hand_pos - self.target_position)
        return np.exp(-distance)
    @composer.observable
    def target_position_obs(self, physics):
        return self.target_position
# Create custom arena
class SimpleArena(composer.Arena):
    def _build(self):
        self.mjcf_model.worldbody.add('geom',
            type='plane', size=[2, 2, 0.1], rgba=[0.5, 0.5, 0.5, 1])
# Create environment
arena = SimpleArena()
task = ReachTask(target_position=[0.5, 0.5, 0.5])
env = composer.Environment(task=task, arena=arena, time_limit=10.0)
""",
    "Entity Composition": """
# Load robot entity
robot_model = mjcf.from_path('/path/to/robot.xml')
robot = composer.ModelWrapperEntity(robot_model)
# Create observable for joint positions
@composer.observable
def joint_positions(physics):
    return physics.named.data.qpos[robot.joints]
# Add observable to robot
robot.observables.add_observable('joint_pos', joint_positions)
# Create custom entity
class Ball(composer.Entity):
    def _build(self):
        self.mjcf_model.worldbody.add('body', name='ball').add(
            'geom', type='sphere', size=[0.05], rgba=[1, 0, 0, 1])
    @composer.observable
    def position(self, physics):
        return physics.named.data.xpos['ball']
ball = Ball()
""",
    "Advanced Task Design": """
class MultiObjectiveTask(composer.Task):
    def __init__(self, robots, targets):
        self.robots = robots
        self.targets = targets
        self.weights = [1.0, 0.5, 0.2] # Objective weights
    def get_reward(self, physics):
        rewards = []
        # Primary objective: reach target
        for robot, target in zip(self.robots, self.targets):
            hand_pos = physics.named.data.site_xpos[f'{robot.name}_hand']
            distance = np.linalg.norm(hand_pos - target)
            rewards.append(np.exp(-distance))
        # Secondary objective: energy efficiency
        control_cost = np.sum(physics.data.ctrl ** 2)
        rewards.append(-0.1 * control_cost)
        # Tertiary objective: smoothness
        velocity_cost = np.sum(physics.named.data.qvel ** 2)
        rewards.append(-0.01 * velocity_cost)
        return np.dot(rewards, self.weights)
    @composer.observable
    def objective_values(self, physics):
        # Return individual objective values for analysis
        return np.array([self.get_reward(physics)])
""",
    "Observable Management": """
class SensorEntity(composer.Entity):
    def _build(self):
        # Add sensors to model
        self.mjcf_model.sensor.add('accelerometer',
            name='accel', site='sensor_site')
        self.mjcf_model.sensor.add('gyro',
            name='gyro', site='sensor_site')
    @composer.observable
    def acceleration(self, physics):
        return physics.named.data.sensordata['accel']
    @composer.observable
    def angular_velocity(self, physics):
        return physics.named.data.sensordata['gyro']
    @composer.cached_property
    def sensor_site(self):
        return self.mjcf_model.find('site', name='sensor_site')
# Use in environment
sensor_entity = SensorEntity()
task = composer.NullTask()
env = composer.Environment(task=task)
# Access observations
time_step = env.reset()
accel_obs = time_step.observation['acceleration']
gyro_obs = time_step.observation['angular_velocity']
""",
}
