"""A wire between host and servos that somebody listens to: every instruction that the host sends is kept."""

import os
import select
import threading
import tty

from sim2real.hardware.bus.packets import Instruction, Parser
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import PROTOCOL

# Torque Enable, and Goal PWM, Goal Current, Goal Velocity, Goal Position: what makes a DYNAMIXEL X move.
TORQUE = (reg.TORQUE_ENABLE.address, reg.TORQUE_ENABLE.end)
GOALS = ((100, 108), (116, 120))
_WRITES = (Instruction.WRITE, Instruction.SYNC_WRITE)
_READS = (Instruction.PING, Instruction.READ, Instruction.SYNC_READ, Instruction.BULK_READ)


class Wiretap:
    """A pseudo-terminal before a robot's: `port` is for the host."""

    def __init__(self, robot_port):
        self.packets = []
        self._parser = Parser(PROTOCOL)
        self._host, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._robot = os.open(robot_port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._robot)
        self._end, self._ended = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while True:
            ready = select.select([self._host, self._robot, self._end], [], [])[0]
            if self._end in ready:
                return
            if self._host in ready:
                data = os.read(self._host, 4096)
                self.packets += [packet for packet, _ in self._parser.feed(data)]
                os.write(self._robot, data)
            if self._robot in ready:
                os.write(self._host, os.read(self._robot, 4096))

    def close(self):
        os.write(self._ended, b"x")
        self._thread.join(5)
        for fd in (self._host, self._slave, self._robot, self._end, self._ended):
            os.close(fd)

    def writes(self):
        """Return (servo, address, bytes) of everything that was written."""
        found = []
        for p in self.packets:
            assert p.code in (*_WRITES, *_READS), f"whether {p} moves a motor is not known here"
            address = int.from_bytes(p.parameters[:2], "little")
            if p.code == Instruction.WRITE:
                found.append((p.servo_id, address, p.parameters[2:]))
            elif p.code == Instruction.SYNC_WRITE:
                length, rest = int.from_bytes(p.parameters[2:4], "little"), p.parameters[4:]
                starts = range(0, len(rest), 1 + length)
                found += [(rest[i], address, rest[i + 1 : i + 1 + length]) for i in starts]
        return found

    def motions(self):
        """Return the writes that could move a motor: a goal, or torque on."""
        found = []
        for servo, address, data in self.writes():
            end = address + len(data)
            goal = any(address < last and end > first for first, last in GOALS)
            torque = address < TORQUE[1] and end > TORQUE[0] and data[TORQUE[0] - address] != 0
            if goal or torque:
                found.append((servo, address, data))
        return found

    def torque_offs(self):
        """Return how often a servo was told to let go."""
        return sum(address == TORQUE[0] and data == b"\0" for _, address, data in self.writes())
