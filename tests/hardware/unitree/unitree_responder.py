"""Twelve joints behind a Go2's topics, as a process: for tests of the device alone, without a body or a ground."""

import json
import random
import select
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from sim2real.hardware.emulation.truth import Kind, TruthLog, read_truth
from sim2real.hardware.unitree.dds import Address, _Domains
from sim2real.hardware.unitree.messages import COMMAND_TOPIC, MOTORS, OFF, STATE_TOPIC, LowCmd, LowState

PERIOD_S, INERTIA = 0.002, 0.1
CONTROLS, DAMPS = 1, 2
START_RAD = np.array([0.1, 0.9, -1.8] * 4)


class Responder:
    """The running process, in a domain that nobody else uses; faults have the names of ``Emulation``."""

    def __init__(self, truth_path, **settings):
        self.port, self._truth = f"lo:{random.SystemRandom().randrange(10, 230)}", truth_path
        command = [sys.executable, "-P", __file__, self.port, str(truth_path), json.dumps(settings)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout.readline() == "ready\n"

    def stop(self):
        self.process.communicate()  # its input ends, and with it the loop

    def truth(self):
        return read_truth(self._truth)


class Joints:
    """Joints of an inertia, and what their motors were commanded last."""

    def __init__(self):
        self.q, self.dq, self.tau = START_RAD.copy(), np.zeros(MOTORS), np.zeros(MOTORS)
        self.command = LowCmd().record["motor_cmd"][:MOTORS]

    def step(self):
        c = self.command
        self.tau = c["tau"] + c["kp"] * np.where(c["kp"], c["q"] - self.q, 0.0) + c["kd"] * (c["dq"] - self.dq)
        self.tau[c["mode"] == OFF] = 0.0
        self.dq = self.dq + PERIOD_S * self.tau / INERTIA
        self.q = self.q + PERIOD_S * self.dq

    def ways(self):
        """Return for each motor: off, controls or damps."""
        c = self.command
        return np.where(c["mode"] == OFF, OFF, np.where((c["kp"] == 0.0) & (c["tau"] == 0.0), DAMPS, CONTROLS))

    def state(self, tick):
        message = LowState()
        record = message.record
        motor = record["motor_state"][:MOTORS]
        motor["mode"], motor["q"], motor["dq"] = self.command["mode"], self.q, self.dq
        motor["tau_est"], motor["temperature"] = self.tau, 30
        record["imu_state"]["quaternion"], record["imu_state"]["accelerometer"] = (1, 0, 0, 0), (0, 0, 9.81)
        record["power_v"], record["bms_state"]["soc"], record["tick"] = 28.0, 80, tick
        message.sign()
        return message


def serve(port, truth_path, settings):
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    address, domains = Address.parse(port), _Domains()
    domains.use(address)
    participant = DomainParticipant(address.domain)
    reader = DataReader(participant, Topic(participant, COMMAND_TOPIC, LowCmd))
    writer = DataWriter(participant, Topic(participant, STATE_TOPIC, LowState))
    truth = TruthLog(Path(truth_path), {"state_names": [], "servo_ids": list(range(MOTORS)), "truth": {}})
    draw = random.Random(settings.get("seed", 0))
    age = round(settings.get("sensing_latency_s", 0.0) / PERIOD_S)
    joints, ways, samples, held_s = Joints(), np.zeros(MOTORS, int), [], 0.0
    print("ready", flush=True)
    begin_s = next_s = time.monotonic()
    tick = 0
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        next_s += PERIOD_S
        time.sleep(max(0.0, next_s - time.monotonic()))
        now_s, now_ns = time.monotonic(), time.monotonic_ns()
        tick += 2
        silent = now_s - begin_s > settings.get("silent_after_s", 1e9)
        # Commands: the last one with a correct CRC counts until the next.
        for command in [] if silent else reader.take(16):
            if isinstance(command, LowCmd) and command.intact and command.record["level_flag"] == 0xFF:
                joints.command = command.record["motor_cmd"][:MOTORS]
                for i in np.flatnonzero(joints.ways() != ways):
                    truth.write(Kind.EFFECT, int(i), now_ns, now_ns, 0, 0, (float(joints.ways()[i]), 0.0))
                ways = joints.ways()
        joints.step()
        # States, with their faults.
        samples.append((now_ns, joints.state(tick)))
        if len(samples) <= age or silent:
            continue
        if held_s == 0.0 and draw.random() < settings.get("late", 0.0):
            held_s = now_s + settings["late_s"]
        while len(samples) > age and now_s >= held_s:
            held_s = 0.0
            sampled_ns, state = samples.pop(0)
            if draw.random() < settings.get("corrupt", 0.0):
                state.record["crc"] ^= 1
            if draw.random() >= settings.get("reply_loss", 0.0):
                writer.write(state)
                truth.write(Kind.SAMPLE, 0, time.monotonic_ns(), sampled_ns, 0, 0)
        truth.flush_if_due(now_ns)
    truth.close()


if __name__ == "__main__":
    serve(*sys.argv[1:3], json.loads(sys.argv[3]))
