"""An emulated ODrive: what the board does with each line, in planned time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from sim2real.emulation.bus import BusEmulation, PlannedBus, Request
from sim2real.emulation.plant import Plant
from sim2real.emulation.truth import TruthLog
from sim2real.hardware.device import OperatingMode

from .odrive import CLOSED_LOOP, IDLE, STATE, TURN, WATCHDOG, SpeedLoop, framed, unframed

_ERROR, _TIMEOUT, _INPUT = "axis0.error", "axis0.config.watchdog_timeout", "axis0.controller.input_vel"
_WATCHDOG_EXPIRED = 0x800


class Lines:
    """Cuts what the host sends into lines."""

    def __init__(self) -> None:
        self._begun = b""

    def clear(self) -> None:
        """Forget the beginning of a line."""
        self._begun = b""

    def feed(self, chunk: bytes) -> list[tuple[bytes, int]]:
        """Return the lines that a chunk completes, each with the number of its bytes up to the line's end."""
        *complete, rest = chunk.split(b"\n")
        found, end = [], 0
        for part in complete:
            end += len(part) + 1
            found.append((self._begun + part, end))
            self._begun = b""
        self._begun += rest
        return found


class Axis:
    """Properties and firmware of axis 0, without time, line and physics; it is a ``Firmware`` of ``emulated_bus``."""

    servo_id = 0
    watchdog_stops = True

    def __init__(self) -> None:
        self.heard_ns = 0
        self.turns = self.turns_per_s = 0.0
        self.properties: dict[str, float] = {
            **dict.fromkeys([*SpeedLoop().properties(), _ERROR, _INPUT, _TIMEOUT, WATCHDOG], 0.0),
            STATE: IDLE,
        }

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor."""
        on = self.properties[STATE] == CLOSED_LOOP
        return (OperatingMode.VELOCITY, TURN * self.properties[_INPUT]) if on else (OperatingMode.OFF, 0.0)

    def controller(self) -> tuple[int, int, float]:
        """Return settings of a position controller, which it has none of."""
        return 0, 0, math.inf

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int) -> None:
        """Set what the encoder shows."""
        del load, tick_ms
        self.turns, self.turns_per_s = position_rad / TURN, velocity_rad_s / TURN

    def watchdog_deadline_ns(self) -> int | None:
        """Return when the watchdog expires; None while it is not enabled, or the axis is stopped already."""
        enabled = self.properties[WATCHDOG] and not self.properties[_ERROR]
        return self.heard_ns + round(1e9 * self.properties[_TIMEOUT]) if enabled else None

    def trip_watchdog(self) -> None:
        """Disarm the motor."""
        self.fail(_WATCHDOG_EXPIRED)

    def fail(self, error: int) -> None:
        """Disarm the motor, with an error."""
        self.properties[_ERROR] = int(self.properties[_ERROR]) | error
        self.properties[STATE] = IDLE

    def request(self, state: int) -> None:
        """Change the state; closed loop only without errors."""
        if state == IDLE or not self.properties[_ERROR]:
            self.properties[STATE] = state


class Board(PlannedBus["ODriveEmulation"]):
    """An ODrive on its line, driving a plant with one motor of id 0.

    Args:
        plant: The mechanism.
        config: Behaviour of line and board.
        truth: Log of true states and latencies.
        send: Called with an answer's bytes.
    """

    def __init__(
        self,
        plant: Plant,
        config: ODriveEmulation,
        truth: TruthLog,
        send: Callable[[bytes], bool],
    ) -> None:
        self.axis = Axis()
        super().__init__(plant, config, truth, send, Lines(), {0: self.axis})

    def execute(self, request: Request) -> None:
        """Carry out a line; one whose checksum is wrong is ignored, as the board does."""
        text = unframed(request.packet)
        if not text:
            return
        axis, (word, *rest) = self.axis, text.split()
        before, sample, answer = axis.command(), None, None
        if word in ("v", "u"):
            axis.heard_ns = request.t_ns
        if word == "v":
            axis.properties[_INPUT] = float(rest[1])
        elif word == "sc":
            axis.properties[_ERROR] = 0
        elif word == "f":
            sample = self.measure(axis, request.t_ns)
            turns = axis.turns + 1000.0 * self.happens(self.config.wild)
            answer = f"{turns:f} {axis.turns_per_s:f}"
        elif word == "r":
            answer = f"{axis.properties[rest[0]]:f}" if rest[0] in axis.properties else "invalid property"
        elif word == "w" and rest[0] == "axis0.requested_state":
            axis.request(int(rest[1]))
        elif word == "w" and rest[0] in axis.properties:
            axis.properties[rest[0]] = float(rest[1])
        elif word != "u":
            answer = "invalid property" if word == "w" else "unknown command"
        if axis.command() != before:
            self.actuate(axis, request)
        if answer is not None:
            self.reply(0, request, framed(answer).replace(b"\n", b"\r\n"), 0.0, sample)


@dataclass(frozen=True)
class ODriveEmulation(BusEmulation):
    """Settings of an emulated ODrive on a serial line."""

    baud_rate: int = 115_200

    def planned(self, physics: Plant, truth: TruthLog, send: Callable[[bytes], bool]) -> Board:
        """Return the board."""
        return Board(physics, self, truth, send)
