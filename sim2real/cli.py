"""The command line: arguments in, a command called, an exit code out."""

import os
import signal
import sys
from collections.abc import Sequence

from sim2real.commands import exit_code
from sim2real.commands.command_kinds import DEMO_PIPELINE, EXIT_CODES
from sim2real.commands.table import COMMANDS, OTHERS
from sim2real.errors import ERROR, OK, Sim2RealError, UsageError, did_you_mean
from sim2real.installation import require_one
from sim2real.later import not_installed
from sim2real.runtime import compilation_cache
from sim2real.stages.terminal.interruption import SignalHandling

_LINES = {name: f"  {name:9} {command.help}" for name, command in COMMANDS.items()}
_LIST = "\n".join(line for name, line in _LINES.items() if name not in OTHERS)
_OTHERS = "\n".join(_LINES[name] for name in OTHERS)
HELP = f"""\
From a robot's log to a policy that works on that robot

usage: sim2real COMMAND [PIPELINE] [FLAGS]

{_LIST}

also
{_OTHERS}

examples
  sim2real demo --seed 1
  sim2real record {DEMO_PIPELINE} --duration-s 20 --amplitude 1.5
  sim2real train {DEMO_PIPELINE} --help
  sim2real run {DEMO_PIPELINE} --train.episode-s 4
  sim2real report {DEMO_PIPELINE}
  sim2real info runs/{DEMO_PIPELINE}/TIME/record/session.mcap

Results go to stdout, progress and errors to stderr. Every stage writes into runs/PIPELINE/TIME/STAGE.
SIM2REAL_DEBUG=1 shows the traceback of an error.

{EXIT_CODES}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    with SignalHandling() as signals:
        code = _run_command(list(sys.argv[1:] if argv is None else argv), signals)
        compilation_cache.release()
        if argv is None and code != OK:
            exit_code.leave(code)
    return code


def _run_command(arguments: list[str], signals: SignalHandling) -> int:
    """Run a command; print its error, if any, and return its exit code."""
    try:
        _dispatch(arguments)
        sys.stdout.flush()
    except Sim2RealError as error:
        return exit_code.failed(error)
    except BrokenPipeError:  # the reader of our output has closed it, as `head` does: no error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ERROR
    except KeyboardInterrupt:
        return exit_code.ended_by(signal.SIGINT)
    except SystemExit as end:
        if isinstance(end.code, int) and end.code > 128:
            return exit_code.ended_by(end.code - 128)
        return end.code if isinstance(end.code, int) else OK if end.code is None else ERROR
    except OSError as error:
        return exit_code.ended_by(signals.received) if signals.received else exit_code.refused(error)
    except ModuleNotFoundError as error:
        missing = not_installed(error)
        return exit_code.failed(missing) if missing else exit_code.unexpected(error)
    except Exception as error:
        if signals.received:  # an extension that is interrupted while it is imported raises ImportError
            return exit_code.ended_by(signals.received)
        return exit_code.unexpected(error)
    return OK


def _dispatch(arguments: list[str]) -> None:
    """Find the command and call it."""
    require_one()
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help", "help"):
        print(HELP)
    elif command in ("-V", "--version"):
        import sim2real

        print(f"sim2real {sim2real.__version__}")
    elif command in COMMANDS:
        COMMANDS[command](command, rest)
    else:
        kind = "flag" if command.startswith("-") else "command"
        available = [*COMMANDS, "--help", "--version"] if kind == "flag" else list(COMMANDS)
        raise UsageError(
            f"unknown {kind} {command!r}. Available: {', '.join(available)}",
            hint=did_you_mean(command, available, "see `sim2real --help`"),
        )


if __name__ == "__main__":
    sys.exit(main())
