"""Settings of an emulated bus and its servos that do not depend on the protocol: latencies and faults."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Emulation:
    """Settings of the emulated bus and servos; times of faults count from the emulator's start, or a signal.

    Args:
        baud_rate: Bits per second; a byte takes 10 bits.
        sensing_latency_s: Age of a measurement when the instruction that reads it is complete [s].
        sensing_jitter_s: Half-width of the uniform variation of that age [s]; at most the latency.
        actuation_latency_s: Time from a complete goal instruction to its effect on the motor [s].
        actuation_jitter_s: Half-width of the uniform variation of that time [s]; at most the latency. Commands take
            effect in the order in which they were sent.
        return_delay_us: The servos' Return Delay Time at power-up [us].
        reply_loss: Probability that an answer is lost.
        corrupt: Probability that an answer has a corrupted byte.
        encoder_counts: Resolution of the encoder [counts per revolution].
        plant_step_s: Period of the grid on which the plant is stepped and commands take effect [s]; at most 1 ms.
        seed: Seed of jitter, loss and corruption.
        silent_after_s: Time from which no byte is received or answered, as with an unplugged cable [s]; None: never.
        overload_after_s: Time at which the servos report an overload and switch their torque off [s]; None: never.
        late: Probability that an answer is delayed, as by a USB adapter; later answers wait for it.
        late_s: That delay [s].
        wild: Probability that a read returns a position out of the motors' reach, with a correct checksum.
        frozen_after_s: Time from which reads return the position of that time, and no velocity [s]; None: never.
        unplugged_after_s: Time at which the port goes away, as with a pulled USB plug [s]; None: never.
        ill_after_s: Time from which answers are late or wild [s].
        on_signal: Whether these times, except the overload's, count from SIGUSR1 to the process.
    """

    baud_rate: int = 1_000_000
    sensing_latency_s: float = 0.0
    sensing_jitter_s: float = 0.0
    actuation_latency_s: float = 0.0
    actuation_jitter_s: float = 0.0
    return_delay_us: int = 500
    reply_loss: float = 0.0
    corrupt: float = 0.0
    encoder_counts: int = 4096
    plant_step_s: float = 0.0005
    seed: int = 0
    silent_after_s: float | None = None
    overload_after_s: float | None = None
    late: float = 0.0
    late_s: float = 0.009
    wild: float = 0.0
    frozen_after_s: float | None = None
    unplugged_after_s: float | None = None
    ill_after_s: float = 0.0
    on_signal: bool = False

    def __post_init__(self) -> None:
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
