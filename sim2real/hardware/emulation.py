"""How an emulated bus and its servos behave: latencies, firmware and faults."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.errors import UsageError
from sim2real.hardware import registers as reg


@dataclass(frozen=True)
class EmulatorConfig:
    """How the emulated bus and its servos behave.

    Args:
        baud_rate: Bits per second; a byte takes 10 bits.
        sensing_latency_s: Age of a measurement when the instruction that reads it is complete.
        sensing_jitter_s: Uniform, plus or minus, on each measurement; at most the latency.
        actuation_latency_s: From a complete goal instruction to its effect on the motor.
        actuation_jitter_s: Uniform, plus or minus, on each effect; at most the latency. Order is kept.
        return_delay_us: The servos' Return Delay Time at power-up.
        reply_loss: Probability that an answer never leaves.
        corrupt: Probability that a byte of an answer is flipped.
        encoder_counts: Positions that the encoder tells apart in one revolution.
        plant_step_s: Grid on which the plant is stepped and commands take effect; at most 1 ms.
        model_number: What the servos say they are; their firmware is that model's.
        seed: Of jitter, loss and corruption.
        silent_after_s: From then on nothing is heard or answered, as if the cable were pulled.
        overload_after_s: From then on the servos report an overload, with torque off.
        watchdog_stops: Whether the bus watchdog stops the motor, or only notices; None: as the model's firmware does.
        late: Probability that an answer waits, as in a USB adapter; those behind it wait, too.
        late_s: How long it waits.
        wild: Probability that a position is answered that no motor can reach, with a good checksum.
        frozen_after_s: From then on the servos answer with the position of that moment, at rest.
    """

    baud_rate: int = 1_000_000
    sensing_latency_s: float = 0.0
    sensing_jitter_s: float = 0.0
    actuation_latency_s: float = 0.0
    actuation_jitter_s: float = 0.0
    return_delay_us: int = 500
    reply_loss: float = 0.0
    corrupt: float = 0.0
    encoder_counts: int = reg.COUNTS_PER_REVOLUTION
    plant_step_s: float = 0.0005
    model_number: int = 1060
    seed: int = 0
    silent_after_s: float | None = None
    overload_after_s: float | None = None
    watchdog_stops: bool | None = None
    late: float = 0.0
    late_s: float = 0.009
    wild: float = 0.0
    frozen_after_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense, by name."""
        ranges = {
            "baud_rate": (1, 10_000_000),
            "sensing_jitter_s": (0.0, self.sensing_latency_s),
            "actuation_jitter_s": (0.0, self.actuation_latency_s),
            "return_delay_us": (0, 508),
            "reply_loss": (0.0, 1.0),
            "corrupt": (0.0, 1.0),
            "late": (0.0, 1.0),
            "late_s": (0.0, 1.0),
            "wild": (0.0, 1.0),
            "plant_step_s": (1e-5, 1e-3),
            "encoder_counts": (2, 1 << 24),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"emulator: {name} = {value} is outside [{low}, {high}]")
