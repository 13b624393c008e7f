"""The command line: calls the command that the arguments name, and returns its exit code."""

import contextlib
import importlib
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from textwrap import shorten
from typing import Any, NoReturn

from sim2real.errors import ERROR, EXIT_CODES, OK, Sim2RealError, UsageError, did_you_mean
from sim2real.installation import require_one
from sim2real.later import not_installed
from sim2real.stages.terminal.console import clean
from sim2real.stages.terminal.interruption import SignalHandling

DEBUG = "SIM2REAL_DEBUG"
COMMANDS: Mapping[str, tuple[str, str]] = {
    "record": ("record the robot under an excitation", "stages.stage"),
    "identify": ("identify dynamics, delays and initial states from the log", "stages.stage"),
    "train": ("train a policy on the identified model with the robot's timing", "stages.stage"),
    "deploy": ("run the policy on the robot and compare with the simulation", "stages.stage"),
    "run": ("all four, one after the other; --resume RUN continues an interrupted run", "run.run_command"),
    "report": ("a run as one HTML page, in the Rerun viewer, or beside other runs", "report.report_command"),
    "info": ("about the installation, a pipeline, a log or a run", "info.info"),
    "check": ("predict which parameters a recording, or a planned one, can determine", "stages.check"),
    "validate": ("score an identification on later logs", "stages.validate"),
    "doctor": ("why a policy works in simulation and fails on the robot", "doctor.doctor"),
    "import": ("convert files of other recorders into logs", "stages.import_files"),
    "new": ("write the files of a pipeline for a robot that has a model", "new.new"),
    "export": ("the estimates for MuJoCo, mjlab, Isaac Lab or as JSON; or a policy for numpy alone", "export.export_"),
    "demo": ("run the embedded pendulum, without a robot", "run.demo"),
    "play": ("a walking policy on a twin, in a window or as a video", "play.play"),
}
"""Command -> its line in the help, and its function in ``sim2real.commands``."""
EXAMPLES = ("demo", "play")


def help_text() -> str:
    """Return the text of ``sim2real --help``."""
    lines = {name: f"  {name:9} {text}" for name, (text, _) in COMMANDS.items()}
    commands = "\n".join(line for name, line in lines.items() if name not in EXAMPLES)
    examples = "\n".join(lines[name] for name in EXAMPLES)
    return f"""\
From a robot's log to a policy that works on that robot

usage: sim2real COMMAND [PIPELINE] [FLAGS]

{commands}

examples of whole runs
{examples}

first steps
  sim2real demo --seed 1
  sim2real record pendulum --duration-s 20 --amplitude 1.5
  sim2real train pendulum --help
  sim2real report pendulum
  sim2real new go2 --mjcf go2.xml --log run.csv

Results go to stdout, progress and errors to stderr. Every stage writes into runs/PIPELINE/TIME/STAGE.
{DEBUG}=1 shows the traceback of an error.

{EXIT_CODES}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    with SignalHandling() as signals:
        code = _run_command(list(sys.argv[1:] if argv is None else argv), signals)
        if argv is None and code != OK:
            _leave(code)
    return code


def _run_command(arguments: list[str], signals: SignalHandling) -> int:
    """Run a command; print its error, if any, and return its exit code."""
    try:
        _dispatch(arguments)
        sys.stdout.flush()
    except Sim2RealError as error:
        return _failed(error, arguments)
    except BrokenPipeError:  # the reader of the output, such as `head`, has closed it: no error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ERROR
    except KeyboardInterrupt:
        return _ended_by(signal.SIGINT)
    except SystemExit as end:
        if isinstance(end.code, int) and end.code > 128:
            return _ended_by(end.code - 128)
        return end.code if isinstance(end.code, int) else OK if end.code is None else ERROR
    except OSError as error:
        return _ended_by(signals.received) if signals.received else _refused(error)
    except ModuleNotFoundError as error:
        missing = not_installed(error)
        return _failed(missing, arguments) if missing else _unexpected(error)
    except Exception as error:
        if signals.received:  # an extension whose import is interrupted raises ImportError
            return _ended_by(signals.received)
        return _unexpected(error)
    return OK


def _dispatch(arguments: list[str]) -> None:
    """Find the command and call it."""
    require_one()
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help", "help"):
        print(help_text())
    elif command in ("-V", "--version"):
        import sim2real

        print(f"sim2real {sim2real.__version__}")
    elif command in COMMANDS:
        module, _, name = COMMANDS[command][1].partition(".")
        function: Callable[[str, list[str]], Any] = getattr(
            importlib.import_module(f"sim2real.commands.{module}"), name
        )
        function(command, rest)
    else:
        kind = "flag" if command.startswith("-") else "command"
        available = [*COMMANDS, "--help", "--version"] if kind == "flag" else list(COMMANDS)
        raise UsageError(
            f"unknown {kind} {command!r}. Available: {', '.join(available)}",
            hint=did_you_mean(command, available, "see `sim2real --help`"),
        )


# -- how a command ends


def _failed(error: Sim2RealError, arguments: Sequence[str]) -> int:
    """Print the error's message, notes and hint; return its exit code."""
    _print_traceback()
    # Notes name nodes, and further failures during the clean-up; the hint comes last.
    command = f"{arguments[0]} " if arguments and arguments[0] in COMMANDS else ""
    hint = error.hint or (f"see `sim2real {command}--help`" if isinstance(error, UsageError) else None)
    _complain(f"error: {error.args[0]}", *_notes(error), *([f"\nhint: {hint}"] if hint else []))
    return error.exit_code


def _refused(error: OSError) -> int:
    """Print an operating system's error about a file; return the exit code."""
    if not isinstance(error.filename, str | bytes):
        return _unexpected(error)
    _print_traceback()
    name = shorten(os.fsdecode(error.filename), 200)
    _complain(f"error: {error.strerror}: {name}", *_notes(error), f"\nhint: check its name; {DEBUG}=1 shows more")
    return ERROR


def _unexpected(error: Exception) -> int:
    """Print an unexpected exception, and save its traceback to a file; return the exit code."""
    _print_traceback()
    reason = " ".join(str(error).split()) or "no message"
    try:
        with tempfile.NamedTemporaryFile("w", prefix="sim2real-", suffix=".traceback.txt", delete=False) as file:
            file.write(traceback.format_exc())
            where = f"traceback in {file.name}"
    except OSError:  # e.g. the disk is full, which may be the exception itself
        where = f"{DEBUG}=1 shows the traceback"
    _complain(f"error: {type(error).__name__}: {reason} ({where})", *_notes(error))
    return ERROR


def _ended_by(number: int) -> int:
    """Print the signal that ended the command; return the exit code."""
    _complain("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")
    return 128 + number


def _leave(code: int) -> NoReturn:
    """End this process at once, without the interpreter's shutdown; for commands that ended early.

    If a compiled program still ran in XLA's threads, the interpreter's shutdown would wait for it, or end in a
    segmentation fault. Open logs are closed before, with the status ``aborted``.
    """
    if writer := sys.modules.get("sim2real.log.writer"):
        writer.close_open_logs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _print_traceback() -> None:
    if os.environ.get(DEBUG):
        traceback.print_exc()


def _complain(*lines: str) -> None:
    print(clean("\n".join(lines)), file=sys.stderr)


def _notes(error: BaseException) -> list[str]:
    """Return an exception's notes, each as one line."""
    return [f"  {' '.join(note.split())}" for note in getattr(error, "__notes__", [])]


if __name__ == "__main__":
    sys.exit(main())
