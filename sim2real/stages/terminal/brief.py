"""A stage on one line: dots while it runs; its output is held back, and printed if it fails."""

import io
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

from sim2real.stages.terminal import console


@contextmanager
def brief() -> Iterator[None]:
    """Hold back tables, notes and progress of a block; warnings, and notes that a person must act on, are printed.

    A terminal shows the seconds that have passed and the present activity; a log file gets a dot each second, so that
    neither is silent.
    """
    held = console.HeldOutput(io.StringIO(), sys.stderr.isatty())
    begun_s = time.monotonic()

    def tick() -> None:
        if held.terminal:
            sys.stderr.write(f"\r\033[K  {time.monotonic() - begun_s:.0f} s  {held.activity}"[:100])
        else:
            sys.stderr.write(".")
        sys.stderr.flush()

    # Hold the stage's output back, and show the time or dots.
    sys.stderr.write("  ")
    sys.stderr.flush()
    console.hold(held)
    try:
        with redirect_stdout(held.text), console.ticking(tick):
            yield
    except BaseException:
        # The details may name the cause: a person who asked for few lines needs them now.
        sys.stderr.write(f"\n{held.text.getvalue()}")
        raise
    finally:
        console.hold(None)
    # Replace the display by the duration.
    end = f" {time.monotonic() - begun_s:.0f} s\n"
    sys.stderr.write(f"\r\033[K {end}" if held.terminal else end)
    sys.stderr.flush()
