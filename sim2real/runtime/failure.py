"""How a running graph fails: with the name of the node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sim2real.errors import Sim2RealError


class NodeFailed(Sim2RealError):  # noqa: N818 - an event, as in sim2real.errors
    """A node raised something that is no error of the project's own; that error is the cause.

    Attributes:
        node: The node's name.
    """

    def __init__(self, message: str, node: str, hint: str | None = None) -> None:
        super().__init__(message, hint)
        self.node = node


class GraphTimeout(Sim2RealError):  # noqa: N818
    """Something did not happen in time: a startup, a step, an answer, a stop."""


class Stopped(Exception):  # noqa: N818
    """Unwinds a node's thread when the graph stops; never reaches a caller."""


def named(error: BaseException, node: str, during: str) -> Sim2RealError:
    """Return the error that the caller gets for ``error`` raised by ``node``.

    The project's own errors keep type, message and exit code and get a note; others are wrapped.

    Args:
        error: What was raised.
        node: The node's name.
        during: Where: ``startup``, ``step 12``, ``stop``.
    """
    if isinstance(error, Sim2RealError):
        error.add_note(f"node {node!r}, {during}")
        return error
    failed = NodeFailed(f"node {node!r} failed in its {during}: {type(error).__name__}: {error}", node)
    failed.__cause__ = error
    return failed


@contextmanager
def noted(error: BaseException) -> Iterator[None]:
    """Make what fails in the block a note of the error that is on its way out, so that it keeps its place."""
    try:
        yield
    except Exception as other:
        if other is not error:
            error.add_note(f"then: {type(other).__name__}: {other}")
