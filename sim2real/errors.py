"""The errors of sim2real; each kind has its exit code."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

OK = 0
ERROR = 1
USAGE = 2
SAFETY_STOP = 3
HARDWARE_LOST = 4
DEADLINE = 5
EXIT_CODES = """\
exit codes
  0  finished                    4  hardware lost: a port or a device does not answer
  1  error                       5  deadlines missed (with --strict-timing)
  2  wrong command or flag       130, 143  ended by Ctrl-C, by SIGTERM; the robot is switched off first
  3  safety stop"""
"""The exit codes, for the help of each command."""


class Sim2RealError(ValueError):
    """An error with a message for the user: the event, the name, and the available names.

    Args:
        hint: What to do next; printed as a separate paragraph.

    Attributes:
        exit_code: Exit code of a command that ends with this error.
    """

    exit_code: int = ERROR

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.hint = hint

    def __str__(self) -> str:
        """Return the message, followed by the hint as a separate paragraph."""
        message = super().__str__()
        return f"{message}\n\nhint: {self.hint}" if self.hint else message


class UsageError(Sim2RealError):
    """A command, its configuration or an argument is wrong (exit code 2)."""

    exit_code = USAGE


class NotInstalled(UsageError):  # noqa: N818
    """A command, or a part of a robot, needs a package that this installation lacks (exit code 2)."""


class SafetyStop(Sim2RealError):  # noqa: N818 - an event, not a mistake in the program
    """The robot was stopped by a limit, a watchdog or a value that is not finite (exit code 3)."""

    exit_code = SAFETY_STOP


class DelayChanged(SafetyStop):
    """The robot's delay differs from the delay in the policy's training; the policy moved no joint (exit code 3)."""


class OtherMotion(Sim2RealError):  # noqa: N818
    """A log has a motion that the identified model does not describe, such as a walk for a model in a stand."""


class HardwareLost(Sim2RealError):  # noqa: N818
    """A port or a device does not answer (exit code 4)."""

    exit_code = HARDWARE_LOST


class DeadlineExceeded(Sim2RealError):  # noqa: N818
    """A node missed more deadlines than --strict-timing allows (exit code 5)."""

    exit_code = DEADLINE


def did_you_mean(word: str, names: Iterable[str], otherwise: str) -> str:
    """Return a hint that names the closest of some names, or another hint if none is close."""
    close = difflib.get_close_matches(word, list(names), n=1)
    return f"did you mean {close[0]}?" if close else otherwise
