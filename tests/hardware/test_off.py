"""After "off" nothing is sent: every way out, at every interleaving with the watchdog, and at any error in it."""

import struct
import threading

import numpy as np
import pytest
from families import IDS, SERVOS, STS
from virtual_bus import IdleDevice

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError
from sim2real.hardware.device import VOLTAGE, Counters, Transaction
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

WAYS = ("stop", "stop_quietly", "close", "disable", "make_safe")
NAMES = [family.name for family in SERVOS]


def leave(rig, way):
    getattr(rig if hasattr(rig, way) else rig.device, way)()


class NotingLock:
    """A lock that notes, by an event, that a thread has to wait for it."""

    def __init__(self):
        self._lock, self.waited_for = threading.Lock(), threading.Event()

    def acquire(self, blocking=True, timeout=-1):
        if self._lock.acquire(blocking=False):
            return True
        self.waited_for.set()
        return self._lock.acquire(blocking, timeout)

    def release(self):
        self._lock.release()

    def __enter__(self):
        return self.acquire()

    def __exit__(self, *exception):
        self.release()


def held_up(rig, robot, point):
    """Return (reached, go): the watchdog's call waits at a point until ``go``, and sets ``reached`` there."""
    reached, go, main = threading.Event(), threading.Event(), threading.current_thread()
    owner, name = {
        "before its bus transaction": (rig.device, "command"),
        "before it has the bus": (rig.device.link, "_exchange"),
        "before its bytes are written": (robot, "write"),
        "after its bytes are written": (rig.device.link, "_wire_ns"),
    }[point]
    inner = getattr(owner, name)

    def wait(*arguments, **options):
        if threading.current_thread().name == "watchdog" and not go.is_set():
            reached.set()
            assert go.wait(10.0)
        return inner(*arguments, **options)

    setattr(owner, name, wait)
    assert threading.current_thread() is main
    return reached, go


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "point",
    [
        "before its bus transaction",
        "before it has the bus",
        "before its bytes are written",
        "after its bytes are written",
    ],
)
@pytest.mark.parametrize("family", SERVOS, ids=NAMES)
def test_a_watchdog_that_is_held_up_sends_nothing_after_off(family, point, way):
    robot = family.robot()
    rig = family.rig(robot)
    rig.start()
    rig._lock, rig.device.link._lock = NotingLock(), NotingLock()
    # The watchdog stands at the point; the way out is taken, as far as it goes; then both go on.
    reached, go = held_up(rig, robot, point)
    watchdog = threading.Thread(target=lambda: rig._watch(rig._done), name="watchdog")
    watchdog.start()
    assert reached.wait(10.0)
    leaving = threading.Thread(target=leave, args=(rig, way))
    leaving.start()
    while leaving.is_alive() and not (rig._lock.waited_for.is_set() or rig.device.link._lock.waited_for.is_set()):
        leaving.join(0.001)
    go.set()
    for thread in (watchdog, leaving):
        thread.join(10.0)
        assert not thread.is_alive()
    robot.sleep(0.05)
    assert family.on(robot) == []
    # A loop that goes on is refused, and moves nothing.
    with pytest.raises((SafetyStop, HardwareLost)):
        rig.command(family.moving, 0.0, 1e-9 * robot.now_ns())
    with pytest.raises((SafetyStop, HardwareLost)):
        rig.device.command(family.moving)
    robot.sleep(0.05)
    assert family.on(robot) == []
    rig.close()


@pytest.mark.parametrize(
    "error",
    [KeyError("gain"), struct.error("short"), MemoryError(), SystemExit(2), HardwareLost("no answer")],
    ids=repr,
)
@pytest.mark.parametrize("family", SERVOS, ids=NAMES)
def test_any_error_in_the_watchdog_makes_the_motors_safe_and_is_raised(family, error, monkeypatch, caplog):
    robot = family.robot()
    with family.rig(robot, {"command_timeout_s": 0.1}) as rig:
        rig.start()
        rig.command(family.moving, 0.0, 1e-9 * robot.now_ns())
        sent_ns = robot.now_ns()

        def fail(values):
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(rig.device, "command", fail)
            robot.sleep(0.3)
        assert family.on(robot) == []
        for call in (rig.measure, lambda: rig.command(family.moving, 0.0, 0.0)):
            with pytest.raises((SafetyStop, HardwareLost)) as raised:
                call()
            # An error that has a reason and an exit code of its own is raised as it is.
            assert error is (raised.value if isinstance(error, HardwareLost) else raised.value.__cause__)
        assert type(error).__name__ in caplog.text
    rows = robot.truth().of(Kind.EFFECT)
    off_ns = rows["t_ns"][np.flatnonzero(rows["values"][:, 0] == 0)[0]]
    # At the watchdog's first look after the timeout; it looks every 20 ms.
    assert 0.1e9 < off_ns - sent_ns < 0.121e9


@pytest.mark.parametrize("silent", IDS)
@pytest.mark.parametrize("family", SERVOS, ids=NAMES)
def test_a_silent_servo_keeps_no_other_one_on(family, silent):
    robot = family.robot()
    with family.rig(robot, {"command_timeout_s": 2.0}, silence_s=1.0) as rig:
        rig.start()
        rig.command(family.moving, 0.0, 1e-9 * robot.now_ns())
        assert family.on(robot) == list(IDS)
        cut = robot.bus.servos.pop(silent)
        began_ns = robot.now_ns()
        with pytest.raises(HardwareLost, match=rf"\[{silent}\]"):
            rig.stop()
        assert family.on(robot) == []
        # All at once, so that a silent servo holds up none; each answer that is missing takes 8 ms.
        assert robot.now_ns() - began_ns < 0.2e9
        # The guardian goes on, and gets the servo once it hears again.
        robot.sleep(0.5)
        robot.bus.servos[silent] = cut
        robot.sleep(1.0)
        assert family.on(robot) == []
        assert any("torque is off" in report for report in robot.reports)


def test_a_servo_that_fails_to_switch_on_leaves_none_on():
    robot = STS.robot()
    with STS.rig(robot) as rig:
        cut = robot.bus.servos.pop(3)
        with pytest.raises(HardwareLost):
            rig.start()
        robot.bus.servos[3] = cut
        assert STS.on(robot) == []
        with pytest.raises(Sim2RealError):
            rig.command(STS.moving, 0.0, 0.0)


def test_a_command_that_hangs_does_not_keep_the_torque_on(monkeypatch):
    """As a driver of a plug-in may: `stop` makes the motors safe without the lock."""
    robot = STS.robot()
    monkeypatch.setattr("sim2real.hardware.safety.rig._STOP_WAIT_S", 0.01)
    with STS.rig(robot) as rig:
        rig.start()
        with rig._lock, pytest.raises(HardwareLost):
            rig.stop()
        robot.sleep(0.01)
        assert STS.on(robot) == []


def switch_on_twice(device):
    device.enable()
    device.make_safe()
    device.enable()


@pytest.mark.parametrize("writes", range(1, 40))
@pytest.mark.parametrize("family", SERVOS, ids=NAMES)
def test_made_safe_while_the_torque_goes_on(family, writes, monkeypatch):
    """As by a signal, after any of the instructions of `enable`."""
    robot = family.robot()
    device = family.device(robot)
    with device:
        left, write = [writes], robot.write

        def interrupted(data):
            write(data)
            left[0] -= 1
            if left[0] == 0:
                device.make_safe()

        monkeypatch.setattr(robot, "write", interrupted)
        with pytest.raises(SafetyStop):
            switch_on_twice(device)
        robot.sleep(0.01)
        assert family.on(robot) == []
        assert not device.armed


class Plain(IdleDevice):
    """A device that sends whatever it is told, as a driver of a plug-in may."""

    motors, commanded, silence_s, counters = ("wheel",), VOLTAGE, 0.0, Counters()

    def __init__(self):
        self.log = []

    def disable(self):
        self.log.append("off")

    def command(self, values):
        self.log.append(values.tolist())
        return Transaction(self.clock.now_ns(), 0, 0, 0)

    def reach(self):
        return np.full(1, -10.0), np.full(1, 10.0)

    def enable(self):
        return np.zeros(1)

    def without_host(self): ...

    def measure(self): ...


def test_the_rig_sends_nothing_after_off_to_a_device_that_would_obey():
    device = Plain()
    rig = Rig(device, GateConfig(5.0))
    rig.start()
    watchdog = rig._done
    rig.stop()
    sent = list(device.log)
    assert sent[-1] == "off"
    rig._watch(watchdog)
    rig._watch(threading.Event())
    with pytest.raises(SafetyStop):
        rig.command(np.ones(1), 0.0, 0.0)
    assert device.log == sent
    # The watchdog of the last episode does not speak in the next one.
    rig.start()
    begun = list(device.log)
    rig._watch(watchdog)
    assert device.log == begun
    rig.close()
