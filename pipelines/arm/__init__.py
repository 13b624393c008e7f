"""Three-joint arm of position-controlled servos: reach for a target."""

from sim2real.stages.config import Defaults, DeployConfig, GateLimits, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.training.config import PPOConfig

# Goals in rad. Faster changes than the servos' profile of 5 rad/s are smoothed there, not here.
GATE = GateLimits(limit=1.6, slew_per_s=20.0, max_speed_rad_s=12.0)

DEFAULTS = Defaults(
    record=RecordConfig(amplitude=0.8, low_hz=0.2, high_hz=2.5, gate=GATE),
    # Servos forget where they started within 0.3 s: so does what their profiles were up to, which no sensor measures.
    identify=IdentifyConfig(initial_state="measured", skip_s=0.3),
    train=TrainConfig(episode_s=3.0, sensitivity=False, ppo=PPOConfig(num_envs=256, total_steps=1_500_000)),
    deploy=DeployConfig(episodes=10, duration_s=4.0, gate=GATE),
)
