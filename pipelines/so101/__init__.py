"""SO-101 arm of six Feetech servos: reach for a target, with the jaw at its commanded opening."""

from sim2real.stages.config import Defaults, DeployConfig, GateLimits, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.training.config import PPOConfig

# rad, rad/s, rad/s. Each joint's own limits are narrower; they keep the arm off the table: see robot.py.
GATE = GateLimits(limit=1.75, slew_per_s=8.0, max_speed_rad_s=12.0)

DEFAULTS = Defaults(
    # Slower motion cannot separate a delay from the rotors' inertia: these servos' motion lags as little by either.
    record=RecordConfig(amplitude=0.4, low_hz=0.2, high_hz=6.0, gate=GATE),
    # Friction, torque limits and delays have several optima between them: a search comes before the refinement.
    identify=IdentifyConfig(
        initial_state="measured",
        skip_s=0.3,
        spacing_s=4.0,
        population=24,
        generations=12,
        refine_steps=10,
        max_delay_s=0.04,
        free_run_s=0.0,
    ),
    train=TrainConfig(episode_s=3.0, sensitivity=False, ppo=PPOConfig(num_envs=256, total_steps=2_000_000)),
    deploy=DeployConfig(episodes=10, duration_s=4.0, gate=GATE),
)
