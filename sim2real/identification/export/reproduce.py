"""Computes the figures of a model card again: ``python reproduce.py`` in this folder; needs numpy and mujoco.

``card.json`` holds the figures with their recipes and the numbers of the drives, ``model.xml`` the robot, and
``signals.npz`` the measurements and commands. The functions ``held``, ``setpoint``, ``drive`` and ``verlet`` are the
equations of the drives and of the integrator. Each printed line has the card's figure, the value of this script, and
their difference.
"""

import json
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

FAR_S, NO_LIMIT = 1e3, 1e6
Arrays = Mapping[str, np.ndarray]
Untyped = Any
"""Objects of mujoco, which has no type hints, and of JSON."""
Memory = dict[str, np.ndarray]
Law = Callable[[Untyped, Untyped, Untyped, Arrays, Memory], None]
"""A drive: sets controls, forces and friction of one step. Arguments: model, data, the drive's numbers, commands,
memory.
"""
_mj: Untyped = mujoco


def tick_means(sent_s: np.ndarray, rows: np.ndarray, delay_s: float, tick_s: float, ticks: int) -> np.ndarray:
    """Return the mean of a command over each tick, ``(ticks, n)``; each command holds until the next one arrives."""
    there = np.isfinite(sent_s)
    arrives_s = sent_s[there] + delay_s
    rows = rows[there].reshape(len(arrives_s), -1)
    # The integral of the command is linear between arrivals; the first command also holds before it arrives.
    knots = np.concatenate([[arrives_s[0] - FAR_S], arrives_s, [arrives_s[-1] + FAR_S]])
    held = np.concatenate([rows[:1], rows])
    integral = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(held * np.diff(knots)[:, None], axis=0)])
    edges = tick_s * np.arange(ticks + 1)
    at = np.stack([np.interp(edges, knots, column) for column in integral.T], axis=1)
    return np.diff(at, axis=0) / tick_s


def held(model: Untyped, data: Untyped, numbers: Untyped, command: Arrays, memory: Memory) -> None:
    """Set the controls to the command."""
    del model, numbers, memory
    data.ctrl[:] = next(iter(command.values()))


def setpoint(model: Untyped, data: Untyped, numbers: Untyped, command: Arrays, memory: Memory) -> None:
    """Move the servos' setpoints to the goals with limited speed; dry friction wears off with speed."""
    (goal,) = command.values()
    most = np.array(numbers["profile_rad_s"]) * model.opt.timestep
    before = memory.setdefault("setpoint", goal)
    move = np.clip(goal - before, -most, most)
    memory["setpoint"] = before + move
    data.ctrl[:] = before + move * (1.0 - 0.5 * np.abs(move) / most)
    if "stribeck_rad_s" in numbers:
        friction = memory.setdefault("frictionloss", model.dof_frictionloss.copy())
        model.dof_frictionloss[:] = friction * np.exp(-np.abs(data.qvel) / np.array(numbers["stribeck_rad_s"]))


def drive(model: Untyped, data: Untyped, numbers: Untyped, command: Arrays, memory: Memory) -> None:
    """Set force, stiffness and damping of each drive, and the friction of its joint."""
    n = {name: np.array(value) for name, value in numbers.items()}
    zero, one = np.zeros(len(n["kp"])), np.ones(len(n["kp"]))
    at, dof = n["qpos_at"], n["qvel_at"]
    # The control: gains of the log are in the log's units; with torque off, a share of the damping remains.
    on = command.get("enabled", one) + zero
    goal = command["goal"] - n["zero"] if "goal" in command else zero
    usual = command.get("volts", n["volts_unit"]) / n["volts_unit"]
    strength = 1.0 + n["voltage"] * (np.where(usual > 0.0, usual, 1.0) - 1.0)
    kp = (
        on * strength * n["kp"] * (command["kp"] / n["kp_unit"] if "kp" in command else one)
        if "goal" in command
        else zero
    )
    kd = n["kd"] * (command["kd"] / n["kd_unit"] if "kd" in command else one) * (on + (one - on) * n["released"])
    force = kp * goal + on * kd * command.get("goal_velocity", zero)
    force = force + on * strength * n["gain"] * (command.get("torque", zero) + command.get("duty", zero))
    # Friction, dead zone, back-EMF and cogging, which are 0 unless they were identified.
    if "load" in n:
        usual = memory.setdefault("usual", np.stack([model.dof_damping[dof], model.dof_frictionloss[dof]]))
        angle, speed, limit = data.qpos[at], data.qvel[dof], model.jnt_actfrcrange[n["joints_at"], 1]
        fast, braked = np.abs(speed), on * n["back_emf"]
        beyond = n["eccentric_cos"] * np.cos(angle) + n["eccentric_sin"] * np.sin(angle)
        error = goal - angle - beyond
        dead = np.clip(error, -n["play"], n["play"])
        most = np.where(n["top_speed"] < NO_LIMIT, n["top_speed"] * (kd + usual[0] + braked), np.inf)
        push = kp * (error - dead)
        force = force - kp * (beyond + dead) - push + np.clip(push, -most, most)
        torque = np.clip(force - kp * angle - kd * speed, -limit, limit) - braked * speed
        viscous = np.maximum(usual[0] + n["damping_bias"] * np.sign(speed), 0.0)
        model.dof_damping[dof] = viscous + n["drag"] * fast + braked
        stuck = n["static"] * np.exp(-fast / n["stribeck_rad_s"])
        model.dof_frictionloss[dof] = usual[1] + stuck + n["load"] * np.abs(torque)
        turn = n["cogging_per_turn"] * angle
        data.qfrc_applied[dof] = -n["bias"] - n["cogging_cos"] * np.cos(turn) - n["cogging_sin"] * np.sin(turn)
    data.ctrl[:] = np.concatenate([force, kp + zero, kd + zero])


LAWS: Mapping[str, Law] = {"held": held, "setpoint": setpoint, "drive": drive}


def verlet(model: Untyped, data: Untyped) -> None:
    """Move independent joints by a step of position Verlet, with exact dry friction."""
    h, before, position = model.opt.timestep, data.qvel.copy(), data.qpos.copy()
    # MuJoCo gives inertia, gravity and drive at the middle of the step.
    data.qpos[:] = position + 0.5 * h * before
    _mj.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    _mj.mj_fullM(model, data, inertia)
    damping, dry = model.dof_damping / inertia.diagonal(), h * model.dof_frictionloss / inertia.diagonal()
    push = h * (data.qfrc_actuator + data.qfrc_applied - data.qfrc_bias) / inertia.diagonal()
    moving = before * (1.0 - 0.5 * h * damping)
    # Friction opposes the motion until the joint stops; in the rest of the step it sticks, or moves the other way.
    slowed = moving + push - np.sign(moving) * dry
    turns = np.sign(moving) * slowed < 0.0
    rest = np.where(turns, slowed / np.where(turns, slowed - moving, 1.0), 1.0)
    after = np.where((moving != 0.0) & ~turns, slowed, rest * np.sign(push) * np.maximum(np.abs(push) - dry, 0.0))
    data.qvel[:] = after / (1.0 + 0.5 * h * damping)
    data.qpos[:] = position + 0.5 * h * (before + data.qvel)


def readings(
    xml: str, drives: Untyped, signals: Arrays, run: str, segment: int, ts: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Simulate one segment; return what the encoders read at times ``ts``: positions and velocities ``(N, joints)``.

    Args:
        drives: The entry ``simulation`` of the card. ``law`` names the function of ``LAWS`` that drives joints, with
            ``numbers``; commands act ``command_delay_s`` after they were sent, and the drive's ``lead_s`` later.
        run: Kind of the segments: ``ahead`` (up to the horizon) or ``free`` (a free run).
    """
    model = _mj.MjModel.from_xml_string(xml)
    data, law, memory = _mj.MjData(model), LAWS[drives["law"]], {}
    step = verlet if drives["integrator"] == "verlet" else _mj.mj_step
    tick_s, substeps = drives["tick_s"], round(drives["tick_s"] / model.opt.timestep)
    ticks = math.ceil(ts.max() / tick_s) + 2
    prefix = f"{run}/command/"
    sent_s, delay_s = signals[f"{run}/sent_s"][segment], drives["command_delay_s"] + drives["lead_s"]
    commands = {
        name.removeprefix(prefix): tick_means(sent_s, rows[segment], delay_s, tick_s, ticks)
        for name, rows in signals.items()
        if name.startswith(prefix)
    }
    data.qpos[:], data.qvel[:] = signals[f"{run}/qpos"][segment], signals[f"{run}/qvel"][segment]
    _mj.mj_forward(model, data)
    joints = [model.joint(name) for name in drives["joints"]]
    at, dof = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    moved = [(data.qpos[at].copy(), data.qvel[dof].copy())]
    for k in range(ticks):
        command = {name: rows[k] for name, rows in commands.items()}
        for _ in range(substeps):
            law(model, data, drives["numbers"], command, memory)
            step(model, data)
        # A leapfrog has the velocities of half a step before.
        moved.append((data.qpos[at].copy(), data.qvel[dof] + drives["velocity_lead_s"] * data.qacc[dof]))
    read = ts - drives["measurement_delay_s"]
    position, speed = (
        np.stack([np.interp(read, tick_s * np.arange(ticks + 1), c) for c in np.array(rows).T], axis=1)
        for rows in zip(*moved, strict=True)
    )
    e_cos, e_sin = (np.array(drives["numbers"].get(n, 0.0)) for n in ("eccentric_cos", "eccentric_sin"))
    reading = (
        position + e_cos * np.cos(position) + e_sin * np.sin(position) + np.array(drives["numbers"].get("zero", 0.0))
    )
    return reading, speed * (1.0 - e_cos * np.sin(position) + e_sin * np.cos(position))


def predictions(xml: str, drives: Untyped, signals: Arrays, run: str) -> dict[str, np.ndarray]:
    """Return field -> simulation minus measurement ``(N,)``, at each measurement of the segments of kind ``run``."""
    segments, ts = signals[f"{run}/row"], signals[f"{run}/into"]
    errors = {name: np.full(len(ts), np.nan) for name in drives["fields"]}
    for segment in np.unique(segments):
        pick = segments == segment
        both = readings(xml, drives, signals, run, int(segment), ts[pick])
        for name, (quantity, joint) in drives["fields"].items():
            errors[name][pick] = both[quantity][:, joint] - signals[f"{run}/measured/{name}"][pick]
    return errors


class Card:
    """The folder of a card; simulates when the first figure needs it."""

    def __init__(self, folder: Path) -> None:
        self.card = json.loads((folder / "card.json").read_text(encoding="utf-8"))
        xml = folder / "model.xml"
        self._xml = xml.read_text(encoding="utf-8") if xml.is_file() else ""
        with np.load(folder / "signals.npz") as file:
            self.signals = {name: file[name] for name in file.files}
        self._errors: dict[str, dict[str, np.ndarray]] = {}

    def value(self, recipe: Untyped) -> float:
        """Compute a figure by its recipe in ``card.json``: a quantile of a signal, or an error of the simulation.

        An error is the root mean square of simulation minus measurement of a field, up to a horizon.
        """
        if "signal" in recipe:
            values = self.signals[recipe["signal"]]
            return float(np.quantile(values[np.isfinite(values)], recipe["q"]))
        run = recipe["run"]
        if run not in self._errors:
            self._errors[run] = predictions(self._xml, self.card["simulation"], self.signals, run)
        ahead = self.signals[f"{run}/into"] - self.card["simulation"]["settle_s"]
        pick = (ahead > 0) & (ahead <= recipe["horizon_s"])
        if "recording" in recipe:
            pick &= self.signals[f"{run}/recording"][self.signals[f"{run}/row"]] == recipe["recording"]
        return float(np.sqrt(np.mean(self._errors[run][recipe["field"]][pick] ** 2)))


def main() -> int:
    """Print each figure; return 1 if one differs by more than 1 %."""
    card, worst = Card(Path(__file__).resolve().parent), 0.0
    for figure in card.card["figures"]:
        value = card.value(figure["recipe"])
        off = abs(value - figure["value"]) / max(abs(figure["value"]), 1e-12)
        worst = max(worst, off)
        print(f"{figure['name']}: card {figure['value']:.6g}, here {value:.6g} {figure['unit']} ({100 * off:.2f} %)")
    print(f"{len(card.card['figures'])} figures, the largest difference is {100 * worst:.2f} %")
    return int(not worst <= 0.01)


if __name__ == "__main__":
    sys.exit(main())
