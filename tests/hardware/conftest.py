from pathlib import Path

import pytest

from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.hardware.dynamixel.emulation import EmulatedBus, EmulatorConfig
from sim2real.hardware.emulation.embedded import EmbeddedRobot
from sim2real.hardware.emulation.emulated_bus import truth_header
from sim2real.hardware.emulation.truth import TruthLog, read_truth
from sim2real.hardware.plant import OperatingMode, load_plant

PLANTS = Path(__file__).parent / "plants.py"


@pytest.fixture
def start_robot(tmp_path):
    """Start an emulator process; stopped at the end of the test."""
    robots = []

    def start(plant="FirstOrder", config=None, **plant_args):
        path = tmp_path / f"truth{len(robots)}.bin"
        robots.append(EmbeddedRobot(f"{PLANTS}:{plant}", config or EmulatorConfig(), plant_args, path))
        return robots[-1]

    yield start
    for robot in robots:
        robot.stop()


@pytest.fixture
def open_bus():
    """Open a bus to a robot and shake hands with the servos given; patient, for the machine may be busy."""
    buses = []

    def open_(robot, ids=(1,), mode=None, **config):
        patience = {"max_silence_s": 1.0, "silence_s": 1.0}
        bus = ServoBus(BusConfig(robot.port, **{**patience, **config}))
        buses.append(bus)
        bus.open()
        bus.handshake(dict.fromkeys(ids))
        if mode is not None:
            bus.setup(mode)
            bus.torque(True)
        return bus

    yield open_
    for bus in buses:
        bus.close()


class Bench:
    """An emulated bus in virtual time: no process, no waiting, every instant exact."""

    def __init__(self, path, plant, config, **plant_args):
        self.plant = load_plant(f"{PLANTS}:{plant}", plant_args)
        self.now_ns = 0
        self.sent = []
        self._path = path
        self._log = TruthLog(path, truth_header(self.plant, config, 0))
        self.bus = EmulatedBus(self.plant, config, self._log, self._take, 0, lambda: self.now_ns)
        self.servos = self.bus.servos

    def _take(self, answer):
        self.sent.append((self.now_ns, answer))
        return True

    def run_until(self, t_ns):
        """Go on to a time, stopping at everything that is due on the way."""
        while (due_ns := self.bus.next_due_ns()) is not None and due_ns <= t_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.bus.run_until(self.now_ns)
        self.now_ns = t_ns
        self.bus.run_until(t_ns)

    def send(self, t_ns, *packets):
        self.run_until(t_ns)
        self.bus.feed(b"".join(packets), t_ns)
        self.bus.run_until(t_ns)

    def start_turning(self, servo_id=1, pwm=885, watchdog=0):
        """Put a servo into PWM mode with torque on, past the wire."""
        servo = self.servos[servo_id]
        servo.put(reg.OPERATING_MODE, OperatingMode.PWM)
        for register, value in ((reg.TORQUE_ENABLE, 1), (reg.BUS_WATCHDOG, watchdog), (reg.GOAL_PWM, pwm)):
            servo.write(register.address, register.encode(value))

    def close(self):
        self._log.close()

    def truth(self):
        self.close()
        return read_truth(self._path)


@pytest.fixture
def make_bench(tmp_path):
    benches = []

    def make(plant="FirstOrder", config=None, **plant_args):
        config = config or EmulatorConfig(return_delay_us=0)
        benches.append(Bench(tmp_path / "truth.bin", plant, config, **plant_args))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()
