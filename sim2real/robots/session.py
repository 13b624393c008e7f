"""An open robot: the session that owns port and torque, and the emulated robot behind the port ``embedded``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.emulation.robot import Emulation, VirtualTime
    from sim2real.hardware.device import Device
    from sim2real.hardware.joint import Joint
    from sim2real.hardware.safety.gate import GateConfig


@dataclass(frozen=True)
class Embedded:
    """An emulated robot, used for the port ``embedded``.

    Attributes:
        plant: ``package.module:Name`` or ``path/to/file.py:Name``; see ``load_plant``.
        emulator: Latencies and faults; its seed is replaced by the session's.
        plant_args: Keyword arguments of the plant: JSON-able.
    """

    plant: str
    emulator: Emulation
    plant_args: Mapping[str, Any] = field(default_factory=dict)

    def mounted(self, joints: Sequence[Joint], zero_rad: float) -> Embedded:
        """Return the same robot with its joints mounted; plain joints change nothing.

        Args:
            joints: One for each servo, in the order of the plant's ``servo_ids``.
            zero_rad: Reading of an encoder, from count 0, at the device's 0 [rad].
        """
        if all(joint.is_plain for joint in joints):
            return self
        inside = {"plant": self.plant, "plant_args": dict(self.plant_args)}
        rows = {"joints": [asdict(joint) for joint in joints], "zero_rad": zero_rad}
        return replace(self, plant="sim2real.emulation.plant:MountedPlant", plant_args=inside | rows)


class Session:
    """An open robot, as a context manager; leaving it takes the torque off.

    Attributes:
        rig: The motors behind the safety gate.
        embedded: The running emulated robot, for the port ``embedded``; else None.

    Args:
        device: Returns the device on a port, not opened yet.
        embedded: The emulated robot; None: there is none.
        truth_path: File for the emulated robot's true states and latencies.
        seed: Seed of the emulated robot's jitter and faults.
        joints: How each motor's joint is mounted; default: as the device measures and commands it.

    Raises:
        UsageError: The port is ``embedded``, but the robot has none.
        HardwareLost: The device cannot be opened, or a motor does not answer.
    """

    def __init__(
        self,
        port: str,
        device: Callable[[str], Device],
        gate: GateConfig,
        embedded: Embedded | None,
        truth_path: Path,
        seed: int,
        joints: Sequence[Joint] = (),
    ) -> None:
        # Imported here: training also makes robots, and must not import their drivers.
        from sim2real.hardware.safety.rig import Rig

        self._stack = ExitStack()
        self.embedded: VirtualTime | None = None
        with ExitStack() as opening:
            if port == "embedded":
                if embedded is None:
                    raise UsageError("this robot has no embedded twin", hint="name its port with --port")
                config = replace(embedded.emulator, seed=seed)
                truth_path.parent.mkdir(parents=True, exist_ok=True)
                robot = config.robot(embedded.plant, embedded.plant_args, truth_path)
                self.embedded = opening.enter_context(robot)
                port = self.embedded.port
                # Wait until the last command, torque off, has taken effect, so that it is in the truth file.
                lasts_s = config.actuation_latency_s + config.actuation_jitter_s + 0.01
                opening.callback(self.embedded.clock.sleep, lasts_s)
            self.rig = opening.enter_context(Rig(device(port), gate, joints))
            self._stack = opening.pop_all()

    def __enter__(self) -> Self:
        """Return the open robot, with torque off."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off, close the port, and stop the emulated robot."""
        self._stack.close()
