"""Conformance tests of devices: check the contract of a device with its emulator, in virtual time.

Fill in `make_device` in a test module of your own; pytest runs the rest:

    from sim2real.emulation.conformance import DeviceConformance

    class TestMyServos(DeviceConformance):
        emulation = MyEmulation plant = MyPlant

        def make_device(self, port):
            return MyServos(port, ids=(1, 2))

The device opens its port with `sim2real.hardware.bus.port.open_port` and waits only on its `clock`, so that these tests
take no real time and do not depend on the machine. For a device that is not on a serial port, define `make_robot`
instead of `emulation` and `plant`.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from sim2real.emulation.bus import BusEmulation, VirtualRobot
from sim2real.emulation.plant import Plant
from sim2real.emulation.robot import VirtualTime
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.device import Device, OperatingMode, Reading
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.plausibility import require_parts
from sim2real.hardware.safety.rig import Rig

Started = Callable[..., tuple[VirtualTime, Device]]


class DeviceConformance(ABC):
    """Tests of the contract on which the rig relies; a subclass provides the device and its emulator.

    Attributes:
        emulation: The class of the emulator's settings.
        plant: Makes a plant with the device's motors.
        settings: Settings of the emulator that the device needs, e.g. a model.
        patience_s: Time in which a motor must be in the safe state after its host has died [s].
        safe_modes: Modes of a motor in the safe state.
        no_address: An address without a device.
        silent_after_s: Time after the emulator's start at which it goes silent [s].
    """

    emulation: ClassVar[type[BusEmulation]]
    plant: ClassVar[type[Plant]]
    settings: ClassVar[Mapping[str, Any]] = {}
    patience_s: ClassVar[float] = 1.0
    safe_modes: ClassVar[frozenset[int]] = frozenset({OperatingMode.OFF})
    no_address: ClassVar[str] = "/dev/no-such-port"
    silent_after_s: ClassVar[float] = 0.6

    @abstractmethod
    def make_device(self, port: str) -> Device:
        """Return the device on a port, not opened yet, with a `silence_s` of 0.3 s to 1 s."""

    def make_robot(self, truth_path: Path, **settings: Any) -> VirtualTime:
        """Return a running emulator; ``settings`` are fields of `emulation.robot.Emulation`."""
        config = self.emulation(**{**self.settings, **settings})
        return VirtualRobot(self.plant(), config, truth_path)

    def gate(self, device: Device) -> GateConfig:
        """Return a gate that admits the command at rest; for commands with columns, the whole reach."""
        kind = device.commanded
        if not kind.columns:
            return GateConfig(0.5, stale=kind.stale)
        low, high = device.reach()
        return GateConfig((low.tolist(), high.tolist()), stale=kind.stale)

    @pytest.fixture
    def start(self, tmp_path: Path) -> Iterator[Started]:
        """Yield a function that starts an emulator with settings, and returns it with its device, not opened yet."""
        robots: list[VirtualTime] = []
        devices: list[Device] = []

        def begin(**settings: Any) -> tuple[VirtualTime, Device]:
            robots.append(self.make_robot(tmp_path / f"truth{len(robots)}.bin", **settings))
            devices.append(self.make_device(robots[-1].port))
            return robots[-1], devices[-1]

        yield begin
        for robot, device in zip(robots, devices, strict=True):
            robot.kill_host()  # close devices that a failed test has left open
            device.close()
            robot.stop()

    def play(self, device: Device, rest: np.ndarray, steps: int) -> list[Reading]:
        """Measure and command rest, like a control loop."""
        readings = []
        for _ in range(steps):
            device.command(rest)
            readings.append(device.measure())
            device.clock.sleep(0.01)
        return readings

    def require_safe(self, robot: VirtualTime, device: Device) -> None:
        """Check on the emulator that every motor was driven, and ends in the safe state."""
        robot.clock.sleep(0.05)  # until the last command has taken effect
        rows = robot.truth().of(Kind.EFFECT)
        last = {int(row["servo_id"]): int(row["values"][0]) for row in rows}
        assert len(last) == len(device.motors), f"only {len(last)} of {len(device.motors)} motors were driven"
        assert set(last.values()) <= self.safe_modes, f"the motors end in the modes {last}"

    def test_a_closed_device_touches_nothing(self) -> None:
        """Before its port is opened, its properties are readable and its counters are zero; `close` has no effect."""
        device = self.make_device(self.no_address)
        kind = device.commanded
        assert device.motors
        assert len(kind.units) == len(kind.columns) or kind.stale in ("zero", "hold")
        assert all(part.unit for part in device.parts.values())
        assert device.load_unit
        assert device.counters.transactions == 0
        device.make_safe()
        device.close()
        with pytest.raises(HardwareLost):
            device.open()

    def test_it_opens_without_torque_and_reports_its_reaction_without_a_host(self, start: Started) -> None:
        """Opening drives no motor; `without_host` lists each motor once; `reach` has one entry for each."""
        robot, device = start()
        with device:
            phrases = [phrase.partition("(")[2].partition(")")[0] for phrase in device.without_host()]
            listed = [name for names in phrases for name in names.split(", ")]
            assert sorted(listed) == sorted(device.motors)
            columns = device.commanded.columns
            shape = (len(device.motors), len(columns)) if columns else (len(device.motors),)
            assert all(limit.shape == shape for limit in device.reach())
            require_parts(device.measure().parts, device.parts)
            facts = device.facts()
            assert set(facts) <= {"firmware", "voltage", "temperature"}
            assert all(isinstance(text, str) and text for values in facts.values() for text in values.values())
        robot.stop()
        modes = robot.truth().of(Kind.EFFECT)["values"][:, 0]
        assert set(modes.tolist()) <= {OperatingMode.OFF}

    def test_a_reading_has_the_time_of_its_instruction(self, start: Started) -> None:
        """The stamp lies within the call, and equals the emulator's time of the instruction; the counters count it."""
        robot, device = start(sensing_latency_s=0.004)
        with device:
            before, begin_ns = device.counters, robot.clock.now_ns()
            readings = [device.measure() for _ in range(20)]
            end_ns = robot.clock.now_ns()
            done = device.counters
        # Stamps increase, and lie within the time of the test.
        stamps = np.array([r.transaction.t_sent_ns for r in readings])
        assert begin_ns <= stamps[0]
        assert stamps[-1] <= end_ns
        assert np.all(np.diff(stamps) > 0)
        n = len(device.motors)
        assert all(r.position_rad.shape == r.velocity_rad_s.shape == r.load.shape == (n,) for r in readings)
        assert done.transactions - before.transactions >= 20
        assert done.late_s.size >= 20
        # Compare them with the emulator's true times of sampling.
        robot.stop()
        samples = robot.truth().of(Kind.SAMPLE)
        nearest = np.array([np.min(np.abs(samples["t_host_ns"] - t)) for t in stamps])
        assert np.max(nearest) < 1e6
        taken = np.median(samples["t_host_ns"] - samples["t_ns"]) * 1e-9
        assert 0.002 < taken < 0.005

    def test_torque_goes_on_at_rest_and_off(self, start: Started) -> None:
        """Right after `enable` the motors stay at their positions; `enable` works again after `disable`."""
        robot, device = start()
        with device:
            still, readings = device.measure().position_rad, []
            for _ in range(2):
                readings = self.play(device, device.enable(), 5)
                device.disable()
            np.testing.assert_allclose(readings[-1].position_rad, still, atol=0.05)
        self.require_safe(robot, device)

    @pytest.mark.parametrize("fault", [{"reply_loss": 0.15}, {"corrupt": 0.15}, {"late": 0.15, "late_s": 0.012}])
    def test_faults_are_survived_and_counted(self, start: Started, fault: Mapping[str, float]) -> None:
        """Lost, corrupted or late answers cause retries, and never a wrong reading."""
        _, device = start(seed=3, **fault)
        with device:
            readings = [device.measure() for _ in range(60)]
            counters = device.counters
        spread = np.ptp([r.position_rad for r in readings], axis=0)
        assert np.all(spread < 0.05), f"the motors stand still, but their readings differ by {spread} rad"
        assert counters.retries <= counters.lost_replies
        assert (counters.late_replies if "late" in fault else counters.lost_replies) >= 2
        if "late" not in fault:
            assert max(r.transaction.retries for r in readings) >= 1

    def test_silence_is_hardware_lost(self, start: Started) -> None:
        """A device that no longer answers raises HardwareLost; `make_safe` and `close` still return normally."""
        _, device = start(silent_after_s=self.silent_after_s)
        with device:
            rest = device.enable()
            with pytest.raises(HardwareLost):
                self.play(device, rest, 100_000)
            device.make_safe()

    @pytest.mark.parametrize("way", ["close", "exception", "make_safe", "in an instruction", "rig"])
    def test_every_way_out_takes_the_torque_off(self, start: Started, way: str) -> None:
        """Every way of stopping takes the torque off, also during an instruction; `make_safe` holds until `open`."""
        robot, device = start()
        if way in ("rig", "exception"):
            with pytest.raises(ZeroDivisionError):
                (self._fail_in_a_rig if way == "rig" else self._fail)(device)
        else:
            device.open()
            rest = device.enable()
            self.play(device, rest, 3)
            if way == "in an instruction":
                self._stop_in_an_instruction(device, rest)
            elif way == "make_safe":
                device.make_safe()
                with pytest.raises(SafetyStop):
                    device.enable()
            device.close()
            device.close()
        self.require_safe(robot, device)

    def test_a_host_that_is_killed_leaves_no_torque(self, start: Started) -> None:
        """After the death of the host, its guardian or the motors themselves take the torque off."""
        robot, device = start()
        device.open()
        self.play(device, device.enable(), 10)
        killed_ns = robot.clock.now_ns()
        robot.kill_host()
        robot.clock.sleep(self.patience_s)
        self.require_safe(robot, device)
        rows = robot.truth().of(Kind.EFFECT)
        assert (rows["t_ns"][-1] - killed_ns) * 1e-9 < self.patience_s

    def test_a_dry_run_moves_nothing(self, start: Started) -> None:
        """A rig in a dry run drives no motor, and keeps its bus as busy."""
        robot, device = start()
        with Rig(device, self.gate(device)) as rig:
            rig.withhold_torque()
            rig.start()
            for _ in range(5):
                rig.measure()
                rig.command(rig.gate.fallback, 0.0, 1e-9 * rig.clock.now_ns())
            assert len(rig.commanding.transfer_us) == 5
            rig.stop()
        robot.stop()
        assert robot.truth().of(Kind.EFFECT).size == 0

    def _fail(self, device: Device) -> None:
        with device:
            self.play(device, device.enable(), 3)
            raise ZeroDivisionError

    def _fail_in_a_rig(self, device: Device) -> None:
        with Rig(device, self.gate(device)) as rig:
            rig.start()
            rig.measure()
            raise ZeroDivisionError

    def _stop_in_an_instruction(self, device: Device, rest: np.ndarray) -> None:
        """Call `make_safe` from another thread, while this one waits on the device's clock."""
        clock = device.clock
        inner, left = clock.now_ns, [3]

        def interrupted() -> int:
            left[0] -= 1
            if left[0] == 0:
                helper = threading.Thread(target=device.make_safe)
                helper.start()
                helper.join()
            return inner()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(clock, "now_ns", interrupted)
            with pytest.raises((HardwareLost, SafetyStop)):
                self.play(device, rest, 5)
        assert left[0] <= 0
