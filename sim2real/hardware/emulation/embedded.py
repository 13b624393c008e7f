"""An emulated robot: starts and stops the emulator as a separate process."""

import contextlib
import json
import logging
import select
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import Field, asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar, Final, Protocol, Self, cast

from sim2real.errors import HardwareLost
from sim2real.hardware.emulation.truth import Truth, read_truth

_LOGGER = logging.getLogger(__name__)
_START_TIMEOUT_S: Final = 20.0
_STOP_TIMEOUT_S: Final = 3.0


class Emulated(Protocol):
    """Settings of an emulated robot: a dataclass whose fields become flags of its process.

    Attributes:
        actuation_latency_s: Time from a command to its effect [s].
        actuation_jitter_s: Half-width of the variation of that time [s].
    """

    __dataclass_fields__: ClassVar[dict[str, Field]]
    program: ClassVar[str]
    if TYPE_CHECKING:

        @property
        def seed(self) -> int: ...
        @property
        def actuation_latency_s(self) -> float: ...
        @property
        def actuation_jitter_s(self) -> float: ...


class EmbeddedRobot:
    """Emulated servos on `port`, from construction until `stop` or any end of this process.

    The stages get only the port. The emulator logs true states and latencies to the truth file; `truth` and `reveal`
    read it.

    Args:
        plant: `package.module:Name` or `path/to/file.py:Name`; see `load_plant`.
        plant_args: Keyword arguments for the plant: JSON-able.
        truth_path: The truth file; None: a temporary file, deleted by `stop`.

    Raises:
        HardwareLost: The emulator did not start; its own message is included.
    """

    def __init__(
        self,
        plant: str,
        config: Emulated,
        plant_args: Mapping[str, Any] | None = None,
        truth_path: Path | str | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sim2real-robot-")
        folder = Path(self._folder.name)
        self.truth_path = Path(truth_path) if truth_path is not None else folder / "truth.bin"
        self.truth_path.parent.mkdir(parents=True, exist_ok=True)
        self._messages_path = folder / "messages.txt"
        # The settings become flags. -P: files in the user's working directory must not be imported as modules.
        command = [sys.executable, "-P", "-m", config.program, "--until-stdin-closes", "--plant", plant]
        command += ["--emulation", f"{type(config).__module__}:{type(config).__qualname__}"]
        command += ["--truth", str(self.truth_path), "--plant-args", json.dumps(dict(plant_args or {}))]
        for name, value in asdict(config).items():
            if value is not None:
                command.append(f"--{name.replace('_', '-')}={value!r}")
        with self._messages_path.open("wb") as messages:
            # In a new session, so that Ctrl-C in a terminal reaches only the host, which then stops the robot.
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=messages, start_new_session=True
            )
        # The emulator prints the port when it is ready.
        ready = self._wait_until_ready()
        self.port: str = ready["port"]
        self.pid: int = ready["pid"]

    def __enter__(self) -> Self:
        """Return the running robot."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop it."""
        self.stop()

    @property
    def running(self) -> bool:
        """Whether the emulator's process is alive."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End the process, after which the truth file is complete. May be called twice."""
        if not self.running and self._process.returncode != 0 and self._messages_path.exists():
            # To the host, a plant that raised an exception looks like a lost bus; the reason is in its messages.
            _LOGGER.error("the emulated robot had died (%d): %s", self._process.returncode, self._messages())
        elif self.running:
            self._process.terminate()
            try:
                self._process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._folder.cleanup()

    def truth(self) -> Truth:
        """Read the truth file; while the robot runs, the last 0.25 s may be missing."""
        return read_truth(self.truth_path)

    def reveal(self) -> dict[str, Any]:
        """Return the plant's true parameters."""
        return self.truth().parameters

    def _wait_until_ready(self) -> dict[str, Any]:
        stdout = cast(IO[bytes], self._process.stdout)
        line = stdout.readline() if select.select([stdout], [], [], _START_TIMEOUT_S)[0] else b""
        if line:
            return json.loads(line)
        message = f"the emulated robot did not start: {self._messages()}"
        self.stop()
        raise HardwareLost(message)

    def _messages(self) -> str:
        """Return the process's messages on stderr."""
        return self._messages_path.read_text(errors="replace").strip() or "without a message"
