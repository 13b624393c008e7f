"""Nodes and the connections between them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from numbers import Real
from typing import TYPE_CHECKING, TypedDict

from sim2real.errors import UsageError
from sim2real.graph.base import Empty, GraphState, StepState, Value
from sim2real.graph.delays import DelayDistribution, StaticDist, TrainableDist
from sim2real.graph.episode import TICKS_PER_S as TICKS_PER_S
from sim2real.types import PyTree

if TYPE_CHECKING:
    import jax


class Scheduling(Enum):
    """The effect of an overrun on the steps after it."""

    FREQUENCY = "frequency"
    """All later steps are scheduled later by the same amount: the distance between steps is kept."""
    PHASE = "phase"
    """Later steps stay at their original times: the node returns to its grid."""


class Jitter(Enum):
    """The arrived messages that a non-blocking input hands over."""

    LATEST = "latest"
    """All arrived messages."""
    BUFFER = "buffer"
    """Arrived messages whose nominal arrival time has passed, too."""


class Connection:
    """An input of ``input_node``, fed by the outputs of ``output_node``; ``BaseNode.connect`` makes it.

    Raises:
        UsageError: An option is out of its range, or two exclude each other.
    """

    def __init__(
        self,
        input_node: BaseNode,
        output_node: BaseNode,
        blocking: bool,
        delay: float | None,
        delay_dist: PyTree,
        window: int,
        skip: bool,
        jitter: Jitter,
        name: str,
    ) -> None:
        self.input_node = input_node
        self.output_node = output_node
        self.blocking = bool(blocking)
        self.skip = bool(skip)
        self.jitter = Jitter(jitter)
        self.name = name
        where = f"connection {output_node.name!r} -> {input_node.name!r} (input {name!r})"
        self.delay_dist = _as_distribution(delay_dist, where)
        self.delay = _expected_delay(delay, self.delay_dist, where)
        self.window = _whole(window, where)
        if self.trainable and (self.blocking or self.jitter is Jitter.BUFFER):
            raise UsageError(
                f"{where}: a trainable delay cannot move when a blocking or buffered message is used, as the step "
                "waits for it or for its nominal arrival",
                hint="make the connection non-blocking with Jitter.LATEST, or give it a fixed delay",
            )
        if self.averaged and not isinstance(input_node, BaseWorld):
            raise UsageError(f"{where}: interp='zoh_mean' is for inputs of a world", hint="use 'zoh' or 'linear'")
        if self.averaged and self.window > 1:
            raise UsageError(f"{where}: interp='zoh_mean' makes one message of all, it has no window of {self.window}")

    @property
    def trainable(self) -> bool:
        """Whether the delay may change while the graph runs (``TrainableDist``)."""
        return isinstance(self.delay_dist, TrainableDist)

    @property
    def averaged(self) -> bool:
        """Whether a tick reads the mean of the command over the tick (``zoh_mean``)."""
        return isinstance(self.delay_dist, TrainableDist) and self.delay_dist.interp == "zoh_mean"

    @property
    def total_window(self) -> int:
        """Number of messages that the runtime keeps for the reader: ``window``, and more for a trainable delay."""
        extra = self.delay_dist.window(self.output_node.rate)
        if self.averaged:  # the mean also uses messages that arrive during the tick
            extra += math.ceil(self.output_node.rate / self.input_node.rate)
        return self.window + extra

    @property
    def phase(self) -> float:
        """Nominal arrival of the sender's first message [s]."""
        return self.phase_ticks / TICKS_PER_S

    @property
    def phase_ticks(self) -> int:
        """Nominal arrival of the sender's first message [ticks]."""
        return phase_ticks(self.output_node) + to_ticks(self.output_node.delay) + to_ticks(self.delay)

    def __repr__(self) -> str:
        return f"Connection({self.output_node.name!r} -> {self.input_node.name!r}, name={self.name!r})"


class NodeOptions(TypedDict, total=False):
    """Options of a ``BaseNode``, for subclasses that hand them on."""

    delay: float | None
    delay_dist: PyTree
    advance: bool
    scheduling: Scheduling
    color: str | None
    order: int | None


class BaseNode:
    """A computation that runs at a fixed rate: override ``step`` and the ``init_*`` methods that it needs.

    Args:
        rate: Nominal frequency [Hz].
        delay: Expected computation delay [s], by which the schedules of readers start later. Default: the 0.99 quantile
            of ``delay_dist``.
        delay_dist: Computation delay in simulation: a distrax distribution over seconds, a ``DelayDistribution`` or a
            number of seconds; default 0.
        advance: Whether a step starts as soon as its blocking inputs have arrived, even before the scheduled time.
            Needs a blocking input; without effect if another input does not block.

    Raises:
        UsageError: A rate or a delay is out of its range.
    """

    jittable: bool = True
    """Whether JAX can trace ``step``; False for a node that talks to hardware in plain Python."""

    def __init__(
        self,
        name: str,
        rate: float,
        delay: float | None = None,
        delay_dist: PyTree = None,
        advance: bool = False,
        scheduling: Scheduling = Scheduling.FREQUENCY,
        color: str | None = None,
        order: int | None = None,
    ) -> None:
        where = f"node {name!r}"
        self.name = name
        self.rate = _rate(rate, where)
        self.delay_dist = _as_distribution(delay_dist, where)
        if isinstance(self.delay_dist, TrainableDist):
            raise UsageError(
                f"{where}: a computation delay cannot be trainable",
                hint="put the TrainableDist on the connection that leaves the node",
            )
        self.delay = _expected_delay(delay, self.delay_dist, where)
        self.advance = bool(advance)
        self.scheduling = Scheduling(scheduling)
        self.color = color
        self.order = order
        self.inputs: dict[str, Connection] = {}
        self.outputs: list[Connection] = []
        self._clock: Callable[[], float] | None = None
        self._origin_ns = 0

    def connect(
        self,
        output_node: BaseNode,
        blocking: bool = False,
        delay: float | None = None,
        delay_dist: PyTree = None,
        window: int = 1,
        skip: bool = False,
        jitter: Jitter = Jitter.LATEST,
        name: str | None = None,
    ) -> Connection:
        """Feed an input of this node with the outputs of another node.

        Args:
            blocking: Whether a step waits for the messages that are due by the nominal schedule.
            delay: Expected communication delay [s], from which phases are computed; default: the 0.99 quantile of
                ``delay_dist``.
            delay_dist: Communication delay in simulation; may be a ``TrainableDist``; default 0.
            window: Number of last messages in the step state.
            skip: Whether to ignore this input in the node's phase (needed once in every loop of connections), and to
                give messages that arrive exactly at a step's start to the next step.
            jitter: Treatment of messages that arrive early at a non-blocking input.
            name: Key in ``step_state.inputs``; default: the sender's name.

        Raises:
            UsageError: The input's name is taken, an option is out of its range, or two exclude each other.
        """
        if not isinstance(output_node, BaseNode):
            raise UsageError(
                f"node {self.name!r}: connect takes the node that sends, got {output_node!r}",
                hint="pass the node, not its name",
            )
        name = name or output_node.name
        if name in self.inputs:
            raise UsageError(
                f"node {self.name!r} has an input {name!r} already. Inputs: {', '.join(self.inputs)}",
                hint="give the second connection another name: connect(..., name='other')",
            )
        connection = Connection(self, output_node, blocking, delay, delay_dist, window, skip, jitter, name)
        self.inputs[name] = connection
        output_node.outputs.append(connection)
        return connection

    @property
    def phase(self) -> float:
        """Nominal start of the first step [s]."""
        return phase_ticks(self) / TICKS_PER_S

    @property
    def phase_output(self) -> float:
        """Nominal time of the first output [s]."""
        return self.phase + self.delay

    def now(self) -> float:
        """Return the time since the episode's start [s] on the runtime's clock; 0 while the node does not run."""
        return self._clock() if self._clock else 0.0

    def at(self, monotonic_ns: int) -> float:
        """Convert a time of the machine's monotonic clock [ns] to the time since the episode's start [s]."""
        return (monotonic_ns - self._origin_ns) / 1e9

    def set_clock(self, clock: Callable[[], float] | None, origin_ns: int = 0) -> None:
        """Set the clock that ``now`` and ``at`` use; called by the runtime.

        Args:
            clock: Returns the time since the episode's start [s]; None if the node does not run.
            origin_ns: The episode's start on the machine's monotonic clock [ns].
        """
        self._clock, self._origin_ns = clock, origin_ns

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the node's parameters."""
        del rng, graph_state
        return Empty()

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the node's state at the start of an episode."""
        del rng, graph_state
        return Empty()

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the default output: the message in a reader's window before the first computed one arrives."""
        del rng, graph_state
        return Empty()

    def init_delays(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return delays [s] by input name, for inputs with a trainable delay; other entries are ignored."""
        del rng, graph_state
        return {}

    def startup(self, graph_state: GraphState, timeout: float | None = None) -> bool:
        """Get ready for an episode on the wall clock: open a port, move to a start. Return False on a failure."""
        del graph_state, timeout
        return True

    def stop(self, timeout: float | None = None) -> bool:
        """Make the hardware safe after an episode on the wall clock, however it ended. Return False on a failure."""
        del timeout
        return True

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Return the new step state and the output message."""
        raise NotImplementedError(f"node {self.name!r} ({type(self).__name__}) has no step method")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, rate={self.rate:g})"


class BaseWorld(BaseNode):
    """A simulated world: its steps lie on a fixed grid and each output leaves at the end of its tick.

    Args:
        rate: Ticks per second [Hz].
    """

    def __init__(self, name: str, rate: float, color: str | None = None, order: int | None = None) -> None:
        # Slightly less than the period: rounded to whole microseconds, a tick must not end after the next one starts.
        busy = 0.999 / _rate(rate, f"node {name!r}")
        super().__init__(name, rate, delay=busy, delay_dist=StaticDist(busy), color=color, order=order)


def to_ticks(seconds: float) -> int:
    """Round a time [s] to ticks [us]."""
    return math.floor(seconds * TICKS_PER_S + 0.5)


def phase_ticks(node: BaseNode, _path: tuple[str, ...] = ()) -> int:
    """Return the nominal start of a node's first step [ticks] (timing rule 1).

    Raises:
        UsageError: Connections that are not skipped form a loop; the message names it.
    """
    if node.name in _path:
        loop = " -> ".join([*reversed(_path[_path.index(node.name) :]), _path[-1]])
        raise UsageError(
            f"algebraic loop: {loop}: every node in it waits for another",
            hint="connect one of them with skip=True: it then reads the message of the step before",
        )
    path = (*_path, node.name)
    arrivals = [
        phase_ticks(c.output_node, path) + to_ticks(c.output_node.delay) + to_ticks(c.delay)
        for c in node.inputs.values()
        if not c.skip
    ]
    return max([0, *arrivals])


def _as_distribution(dist: PyTree, where: str) -> DelayDistribution:
    """Return seconds or a distribution as a ``DelayDistribution``; ``where`` names the node or connection in errors."""
    if dist is None:
        return StaticDist(0.0)
    if isinstance(dist, DelayDistribution):
        return dist
    try:
        return StaticDist(dist)
    except UsageError as error:
        raise UsageError(f"{where}: {error.args[0]}", hint=error.hint) from None


def _expected_delay(delay: float | None, dist: DelayDistribution, where: str) -> float:
    """Return the expected delay [s]: ``delay``, or the 0.99 quantile."""
    value = dist.quantile(0.99) if delay is None else delay
    if not (isinstance(value, Real) and math.isfinite(value) and value >= 0):
        raise UsageError(f"{where}: the expected delay must be finite and at least 0 s, got {value!r}")
    return float(value)


def _rate(rate: object, where: str) -> float:
    value = float(rate) if isinstance(rate, Real) else math.nan
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{where}: rate must be a positive number of hertz, got {rate!r}")
    return value


def _whole(window: PyTree, where: str) -> int:
    try:
        count = operator.index(window)
    except TypeError:
        count = 0
    if count < 1:
        raise UsageError(f"{where}: window must be a whole number of messages, at least 1, got {window!r}")
    return count


def by_name(nodes: Mapping[str, BaseNode] | Sequence[BaseNode]) -> dict[str, BaseNode]:
    """Return nodes as a dictionary by name, checked."""
    if not isinstance(nodes, Mapping | Sequence) or isinstance(nodes, str):
        raise UsageError(
            f"the nodes of a graph were expected, got {nodes!r}", hint="pass a list or a dictionary of them"
        )
    # Names are unique, and keys of a dictionary are the names.
    named: dict[str, BaseNode] = {}
    for key, node in nodes.items() if isinstance(nodes, Mapping) else ((None, node) for node in nodes):
        if not isinstance(node, BaseNode):
            raise UsageError(f"a graph is made of nodes, got {node!r}", hint="derive its class from BaseNode")
        if node.name in named:
            raise UsageError(f"two nodes are called {node.name!r}", hint="names are unique in a graph")
        if key not in (None, node.name):
            raise UsageError(f"the key {key!r} stands for a node that is called {node.name!r}")
        named[node.name] = node
    return named


def check_senders(nodes: Mapping[str, BaseNode], among: Mapping[str, object] | None = None) -> None:
    """Check that every sender is in the graph: the same object, not only a node of the same name.

    Args:
        among: Check only senders with these names, as others are missing on purpose; None: all senders.
    """
    for node in nodes.values():
        for c in node.inputs.values():
            sender, where = c.output_node, f"node {node.name!r} listens to"
            if among is not None and sender.name not in among:
                continue
            if sender.name not in nodes:
                raise UsageError(
                    f"{where} {sender.name!r}, which is not in the graph. Nodes: {', '.join(nodes)}",
                    hint="pass every node that another one listens to",
                )
            if nodes[sender.name] is not sender:
                raise UsageError(
                    f"{where} another object called {sender.name!r} ({sender!r}) than the one in the graph "
                    f"({nodes[sender.name]!r})",
                    hint=f"if {sender.name!r} was replaced, connect {node.name!r} to the new node",
                )
