"""Failures of a running graph; each names the node."""

from collections.abc import Iterator
from contextlib import contextmanager

from sim2real.errors import Sim2RealError


class NodeFailed(Sim2RealError):  # noqa: N818 - an event, as in sim2real.errors
    """A node raised an exception other than a ``Sim2RealError``; that exception is the cause."""

    def __init__(self, message: str, node: str, hint: str | None = None) -> None:
        super().__init__(message, hint)
        self.node = node


class GraphTimeout(Sim2RealError):  # noqa: N818
    """A startup, a step, the caller's reply or a stop took too long."""


class Stopped(Exception):  # noqa: N818
    """Raised in a node's thread to end it when the graph stops; no caller receives it."""


def named(error: BaseException, node: str, during: str) -> Sim2RealError:
    """Return the error to raise in the caller's thread for ``error``, which ``node`` raised.

    A ``Sim2RealError`` is returned unchanged, with a note; any other is wrapped in a ``NodeFailed``.
    """
    if isinstance(error, Sim2RealError):
        error.add_note(f"node {node!r}, {during}")
        return error
    try:
        text = str(error)
    except Exception:
        text = "(its text cannot be read)"
    failed = NodeFailed(f"node {node!r} failed in its {during}: {type(error).__name__}: {text}", node)
    failed.__cause__ = error
    return failed


@contextmanager
def noted(error: BaseException) -> Iterator[None]:
    """Add an exception that the block raises to ``error`` as a note, instead of raising it."""
    try:
        yield
    except Exception as other:
        if other is not error:
            for note in (f"then: {type(other).__name__}: {other}", *getattr(other, "__notes__", ())):
                error.add_note(note)
