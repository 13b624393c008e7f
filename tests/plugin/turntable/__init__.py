"""A turntable on an ODrive: turn at a commanded speed."""

from sim2real.stages.config import Defaults, DeployConfig, GateLimits, RecordConfig, TrainConfig
from sim2real.training.config import PPOConfig

GATE = GateLimits(limit=12.0, slew_per_s=200.0, max_speed_rad_s=30.0, servo_watchdog_s=0.3)  # rad/s, rad/s^2, rad/s

DEFAULTS = Defaults(
    record=RecordConfig(duration_s=20.0, amplitude=10.0, low_hz=0.2, high_hz=3.0, gate=GATE),
    train=TrainConfig(episode_s=2.0, ppo=PPOConfig(total_steps=200_000)),
    deploy=DeployConfig(episodes=3, duration_s=3.0, gate=GATE),
)
