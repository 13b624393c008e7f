"""Global search by evolution strategies: without gradients, with restarts and common random numbers."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sim2real.artifacts.identification import Search
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identify.config import FitConfig
from sim2real.identify.problem.programs import OnCompile, Program
from sim2real.identify.search.pytrees import strong
from sim2real.types import Array, Key, PyTree

Losses = Callable[[Any, Any, Any, Any], Any]
"""``candidates (N, P), around (P,), data, pick (B,) or None -> losses (N,)``, traceable; ``data`` is any pytree."""
HostLosses = Callable[[np.ndarray, np.ndarray, np.ndarray | None, bool], np.ndarray]
"""The same in numpy, with its own data: ``candidates, around, pick, fresh -> losses``. ``fresh`` is true in the first
generation of a block; the other generations may use its results at ``around``."""
_BLOCK = 10
"""Generations in one call of the program; after each block the search decides whether to continue."""
_NARROW = 0.02
"""Deviation of a generation's candidates at which the search ends; 1 is about a quarter of the bounds' width."""
_STANDSTILL = 0.01
"""Relative improvement of the generations' median between blocks below which a search stands still."""
_INFINITE = 1e9


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        z: Shape ``(P,)``: the best candidate.
        loss: Its loss, on all segments.
        finalists: Shape ``(K, P)``: the best of each run, best first.
        record: Strategy, evaluations, and the best loss up to each generation, on the segments of that generation.
    """

    z: np.ndarray
    loss: float
    finalists: np.ndarray
    record: Search


def strategies() -> list[str]:
    """Return the names of the algorithms of evosax."""
    import evosax.algorithms  # 2 s

    return sorted(n for n, a in vars(evosax.algorithms).items() if inspect.isclass(a) and hasattr(a, "ask"))


def search(
    losses: Losses | HostLosses,
    start: np.ndarray,
    config: FitConfig,
    data: PyTree = None,
    weight: np.ndarray | None = None,
    on_generations: Callable[[int, float, np.ndarray], None] | None = None,
    programs: dict[Any, Any] | None = None,
    on_compile: OnCompile | None = None,
    alone: Callable[[np.ndarray], float] | None = None,
    host: bool = False,
) -> SearchResult:
    """Minimise losses; all candidates of a generation get the same data (common random numbers).

    A run ends early when its candidates are close together, or the median of the last ten generations is not below that
    of the ten before. The best candidate does not count, as one of the first generation may be best by chance. Restarts
    follow BIPOP: in turn with twice the largest population so far, and with the first population from a random place,
    with smaller steps.

    Args:
        start: Shape ``(P,)``: middle of the first generation.
        weight: Shape ``(S,)``: batches are drawn from the segments with a weight above 0; None without batches.
        on_generations: Called with the number of generations since the last call, and the best loss and candidate of
            this run so far.
        programs: Compiled programs of earlier calls with the same losses; those of this call are added.
        alone: Loss of one candidate on all segments; default: that of ``losses``.
        host: Whether ``losses`` are ``HostLosses``; these need ``alone``.

    Raises:
        UsageError: When there is no such strategy, or it cannot work with this population.
        Sim2RealError: When no candidate has a finite loss.
    """
    programs = {} if programs is None else programs
    segments = 0 if weight is None else int(np.sum(np.asarray(weight) > 0.0))
    batched = 0 < config.batch < segments
    arguments = (data, jnp.asarray(weight) if batched else None)
    count, runs, histories, evaluations = min(_BLOCK, config.generations), [], [], 0
    for key, middle, std, population in _restarts(start, config):
        # Compile a program for each kind of run; a program has the data as an argument, losses on the host hold it.
        kind = (config.strategy, population, batched and config.batch, config.generations, config.std)
        if kind not in programs:
            programs[kind] = (_HostRun if host else _Run)(losses, config, population, len(start), count, batched)
        if host:
            programs[kind].losses = losses
        z, history, simulated = programs[kind](
            key, middle, std, config.generations, arguments, on_generations, on_compile
        )
        runs.append(z)
        histories.append(history)
        evaluations += simulated
    # Compare the finalists, each with initial states linearised at itself, as they may lie far apart.
    if alone is None:
        traced: Any = losses
        single = programs.setdefault("alone", Program(lambda z, data: traced(z[None], z, data, None)[0]))
        alone = lambda z: float(single(jnp.asarray(z, jnp.float32), data))  # noqa: E731
    finalists, best = _ranked(np.stack(runs), alone)
    history = np.minimum.accumulate(np.concatenate(histories))
    record = Search(strategy=config.strategy, history=history, evaluations=evaluations)
    return SearchResult(finalists[0], best, finalists, record)


def _restarts(start: np.ndarray, config: FitConfig) -> Iterator[tuple[jax.Array, np.ndarray, float, int]]:
    """Yield key, middle ``(P,)``, spread and population of each run."""
    key, large = jax.random.key(config.seed), config.population
    for index in range(config.restarts + 1):
        k_run, k_step, k_middle = jax.random.split(jax.random.fold_in(key, index), 3)
        if index % 2:
            large = 2 * large
            yield k_run, start, config.std, large
        elif index:
            # Hansen draws the population of small runs, too. Each size takes 5 s to compile, so ours keep the first.
            u = float(jax.random.uniform(k_step))
            middle = np.asarray(jax.random.normal(k_middle, start.shape)) * 1.5
            yield k_run, middle, config.std * 10.0 ** (-2.0 * u), config.population
        else:
            yield k_run, start, config.std, config.population


def _ranked(finalists: np.ndarray, alone: Callable[[PyTree], PyTree]) -> tuple[np.ndarray, float]:
    """Return the finalists ``(K, P)``, best first, and the loss of the best."""
    losses = np.array([float(alone(z)) for z in finalists])
    order = np.argsort(np.where(np.isfinite(losses), losses, _INFINITE))
    best = float(losses[order[0]])
    if not best < _INFINITE:
        raise Sim2RealError(
            "no candidate could be simulated: every loss is infinite or no number",
            hint="check the bounds: they may admit only unstable models",
        )
    return finalists[order], best


class _Run:
    """The program of one population size, and a run of it."""

    def __init__(self, losses: Any, config: FitConfig, population: int, size: int, count: int, batched: bool) -> None:
        self.name, self.population, self.count, self.losses = config.strategy, population, count, losses
        self.strategy = _strategy(config, population, size)
        self.by_population = "mean" not in inspect.signature(type(self.strategy).init).parameters
        self.batched, self.batch = batched, config.batch
        self.devices = jax.local_devices()[: config.devices]
        self.advance: Callable[..., PyTree] = Program(self._advance)

    def __call__(
        self,
        key: Key,
        middle: np.ndarray,
        std: float,
        generations: int,
        data: PyTree,
        report: Callable[[int, float, np.ndarray], None] | None,
        on_compile: OnCompile | None,
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the best candidate ``(P,)``, the best loss up to each generation, and the number of evaluations."""
        # Start around the middle of the bounds.
        params = self.strategy.default_params
        if hasattr(params, "std_init"):
            params = params.replace(std_init=std)
        params = strong(params)
        k_first, *keys = jax.random.split(key, 1 + -(-generations // self.count))
        first = self._first(k_first, jnp.asarray(middle, jnp.float32), std, params, data)
        state = strong(first)  # else it compiles twice
        history: list[np.ndarray] = []
        median = np.inf
        # Advance by several generations in one program, until the spread or the progress is small.
        for k_generations in keys:
            state, (best, medians, width) = self.advance(state, params, k_generations, data, on_compile=on_compile)
            history.append(np.asarray(best))
            if not self.by_population and not np.isfinite(np.asarray(self._middle(state))).all():
                raise UsageError(
                    f"the strategy {self.name!r} breaks down: with a population of {self.population} for "
                    f"{middle.size} parameters its candidates are no numbers",
                    hint="try another population, or CMA_ES",
                )
            if report:
                report(self.count, float(np.min(history[-1])), np.asarray(self._best(state)))
            before, median = median, float(np.median(medians))
            # With batches the losses of two generations are on different segments: they show no standstill.
            still = not self.batched and median > (1.0 - _STANDSTILL) * before
            if float(width[-1]) < _NARROW or (still and median < _INFINITE):
                break
        losses = np.minimum.accumulate(np.concatenate(history))
        return np.asarray(self._best(state)), losses, self.population * losses.size

    def _first(self, key: Key, middle: Array, std: float, params: PyTree, data: PyTree) -> PyTree:
        if not self.by_population:
            return self.strategy.init(key, middle, params)
        k_spread, k_pick, k_init = jax.random.split(key, 3)
        spread = std * jax.random.normal(k_spread, (self.population, middle.size))
        candidates = middle + spread.at[0].set(0.0)
        return self.strategy.init(k_init, candidates, self._fitness(candidates, middle, k_pick, data), params)

    def _best(self, state: PyTree) -> PyTree:
        return self._middle(state) if self.batched else state.best_solution

    def _middle(self, state: PyTree) -> PyTree:
        return state.best_solution if self.by_population else self.strategy.get_mean(state)

    def _fitness(self, candidates: Array, around: Array, key: Key, data: PyTree) -> PyTree:
        fitness = self.losses(candidates, around, data[0], self._pick(key, data[1]))
        return jnp.where(jnp.isfinite(fitness), fitness, _INFINITE)

    def _pick(self, key: Key, weight: Array) -> PyTree:
        """Return the segments with the largest of random numbers ``(B,)``; None without batches."""
        if not self.batched:
            return None
        return jax.lax.top_k(jnp.where(weight > 0.0, jax.random.uniform(key, weight.shape), -1.0), self.batch)[1]

    def _divided(self, candidates: Array) -> PyTree:
        """Return candidates that are divided among the devices."""
        return self._spread(candidates, PartitionSpec("candidates"))

    def _on_all(self, values: Any) -> PyTree:
        """Return values that all devices hold, so that each makes the same next generation."""
        return self._spread(values, PartitionSpec())

    def _spread(self, values: Any, how: PartitionSpec) -> PyTree:
        if len(self.devices) == 1:
            return values
        where = NamedSharding(Mesh(np.array(self.devices), ("candidates",), (AxisType.Auto,)), how)
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, where), values)

    def _advance(self, state: PyTree, params: PyTree, key: Key, data: PyTree) -> tuple[PyTree, PyTree]:
        """Make a block of generations; return the state, and best loss, median loss and width of each generation."""

        def generation(state: PyTree, key: Key) -> tuple[PyTree, PyTree]:
            k_ask, k_tell, pick = jax.random.split(key, 3)
            candidates, state = self.strategy.ask(k_ask, state, params)
            fitness = self._on_all(self._fitness(self._divided(candidates), self._middle(state), pick, data))
            state, _ = self.strategy.tell(k_tell, candidates, fitness, state, params)
            return state, (jnp.min(fitness), jnp.median(fitness), jnp.max(jnp.std(candidates, axis=0)))

        return self._on_all(jax.lax.scan(generation, state, jax.random.split(key, self.count)))


class _HostRun(_Run):
    """A run whose candidates are simulated outside of programs."""

    def __init__(self, losses: Any, config: FitConfig, population: int, size: int, count: int, batched: bool) -> None:
        super().__init__(losses, config, population, size, count, batched)
        self._ask, self._tell = Program(self.strategy.ask), Program(self.strategy.tell)
        self.advance = self._generations
        self._fresh = True

    def _generations(
        self, state: PyTree, params: PyTree, key: Key, data: PyTree, on_compile: OnCompile | None
    ) -> PyTree:
        """Make a block of generations; as ``_advance``."""
        rows = []
        self._fresh = True
        for key_of_generation in jax.random.split(key, self.count):
            k_ask, k_tell, pick = jax.random.split(key_of_generation, 3)
            candidates, state = self._ask(k_ask, state, params, on_compile=on_compile)
            fitness = self._fitness(candidates, self._middle(state), pick, data)
            state = strong(self._tell(k_tell, candidates, fitness, state, params, on_compile=on_compile)[0])
            rows.append((np.min(fitness), np.median(fitness), np.max(np.std(candidates, axis=0))))
        return state, tuple(np.array(column) for column in zip(*rows, strict=True))

    def _fitness(self, candidates: Array, around: Array, key: Key, data: PyTree) -> PyTree:
        pick = self._pick(key, data[1])
        points = np.asarray(candidates, np.float64), np.asarray(around, np.float64)
        fitness = self.losses(*points, None if pick is None else np.asarray(pick), self._fresh)
        self._fresh = False
        return jnp.asarray(np.where(np.isfinite(fitness), fitness, _INFINITE), jnp.float32)


def _strategy(config: FitConfig, population: int, size: int) -> PyTree:
    import evosax.algorithms
    import optax

    # Find the algorithm, and the arguments that it needs.
    if config.strategy not in strategies():
        raise UsageError(f"unknown strategy {config.strategy!r}. Available: {', '.join(strategies())}")
    algorithm = getattr(evosax.algorithms, config.strategy)
    arguments: dict[str, PyTree] = {"population_size": population, "solution": jnp.zeros(size)}
    wanted = inspect.signature(algorithm).parameters
    missing = [n for n, p in wanted.items() if p.default is p.empty and n not in arguments]
    if missing:
        raise UsageError(
            f"the strategy {config.strategy!r} needs {', '.join(missing)}, which no search here has", hint="try CMA_ES"
        )
    # Shrink the deviation of strategies that do not adapt it.
    if "std_schedule" in wanted:
        arguments["std_schedule"] = optax.exponential_decay(config.std, config.generations, 0.03)
    try:
        return algorithm(**arguments)
    except (AssertionError, ValueError, TypeError) as error:
        raise UsageError(
            f"the strategy {config.strategy!r} refuses a population of {population}: {error}",
            hint="try another population, or CMA_ES",
        ) from error
