"""Quadruped with a floating base: follow a commanded velocity."""

from sim2real.stages.config import Defaults, DeployConfig, GateLimits, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.training.config import PPOConfig
from sim2real.training.environment.variation import VariationConfig

VARY = VariationConfig(
    range={
        "foot_friction": (0.4, 1.3),
        "payload": (-1.0, 2.5),
        "motor_strength": (0.85, 1.15),
        **{f"{part}_damping": (0.02, 0.4) for part in ("hip", "thigh", "calf")},
        "sensor_delay": (0.007, 0.009),
        "actuator_delay": (0.0, 0.018),
    },
    start_position=0.1,
    start_velocity=0.3,
    push=0.6,
    push_hz=0.25,
)
AFTER_S = 2.0
"""Time in which legs leave their stops and each other, and reach the excitation [s]: no identification models that."""
# rad, rad/s, rad/s, s; each joint has its own range. A motor turns at 30 rad/s at most. On two busy cores this process
# paused for 0.11 s: with the usual 0.1 s the guardian would let a walking robot sink.
GATE = GateLimits(limit=4.6, slew_per_s=60.0, max_speed_rad_s=40.0, servo_watchdog_s=0.25)
WALK = PPOConfig(
    num_envs=4096,
    rollout_steps=24,
    total_steps=110_000_000,
    minibatches=8,
    epochs=4,
    learning_rate=7e-4,
    hidden=(256, 128, 64),
    privileged=True,
    reward_scale=0.05,
    entropy_coef=0.004,
    max_grad_norm=1.0,
    log_std_init=-1.0,
    value_coef=1.0,
    gamma=0.985,
    evaluations=5,
)

DEFAULTS = Defaults(
    record=RecordConfig(duration_s=12.0, amplitude=0.3, low_hz=0.2, high_hz=4.0, gate=GATE),
    identify=IdentifyConfig(folds=0, after_s=AFTER_S),
    train=TrainConfig(model="nominal", episode_s=10.0, timelines=256, sensitivity=False, vary=VARY, ppo=WALK),
    deploy=DeployConfig(episodes=5, duration_s=10.0, max_tilt_rad=1.2, gate=GATE),
)
