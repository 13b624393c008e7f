"""The contract of a policy (observations, actions, rate, limits), and the description of its network."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TypeVar

import msgspec

from sim2real.errors import Sim2RealError, UsageError
from sim2real.types import Json

T = TypeVar("T")

RATES_HZ = (1e-3, 1e5)
"""Smallest and largest number of policy steps per second."""
MAX_DELAY_S = 60.0
"""Longest delay, and longest step of a node [s]."""
MAX_HISTORY = 10_000
BUILT_IN = ("mlp", "gru")
"""Networks that numpy runs."""
MAX_BOUND = 1e9
"""Largest magnitude of a bound or a limit, in any unit; float32 has steps of 64 there."""


@dataclasses.dataclass(frozen=True)
class ObservationTerm:
    """A part of the observation vector.

    Attributes:
        units: The unit of each entry, e.g. ``("1", "1", "rad/s")``; ``"1"``: no unit.
        history: Number of steps in the vector, the newest step first.
        low: Lower bound of each entry [its unit]; empty: unknown. Observations are not clipped to it.
        high: Upper bound of each entry [its unit]; empty: unknown.
    """

    name: str
    units: tuple[str, ...]
    history: int = 1
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.units, str) or not self.units or not 1 <= self.history <= MAX_HISTORY:
            raise UsageError(
                f"observation term {self.name!r} needs at least one unit and one step of history, "
                f"got units={self.units!r} and history={self.history!r}",
                hint=f"units is a tuple with one unit per entry, e.g. ('rad/s',), and history at most {MAX_HISTORY}",
            )
        bounds = len(self.low), len(self.high)
        if bounds not in ((0, 0), (self.size, self.size)) or any(
            not -MAX_BOUND <= low < high <= MAX_BOUND for low, high in zip(self.low, self.high, strict=True)
        ):
            raise UsageError(
                f"observation term {self.name!r} of {self.size} entries has bounds low={self.low}, high={self.high}",
                hint="give each entry both, finite and with low < high, or none of them any; "
                f"no bound may be larger than {MAX_BOUND:g}",
            )

    @classmethod
    def within(cls, name: str, units: tuple[str, ...], most: float = math.inf) -> ObservationTerm:
        """Return a term without history whose entries have magnitudes up to ``most`` [their units].

        An infinite ``most`` means unknown bounds.
        """
        bounds = (most,) * len(units) if most <= MAX_BOUND else ()
        return cls(name, units, 1, tuple(-bound for bound in bounds), bounds)

    @property
    def size(self) -> int:
        """Number of entries of one step."""
        return len(self.units)


def observation_size(terms: Sequence[ObservationTerm]) -> int:
    """Return the number of entries of an observation of terms."""
    return sum(term.size * term.history for term in terms)


@dataclasses.dataclass(frozen=True)
class ActionTerm:
    """One entry of the action vector.

    Attributes:
        unit: ``"1"``: no unit.
        low: Lower bound [unit].
        high: Upper bound [unit].
    """

    name: str
    unit: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if not -MAX_BOUND <= self.low < self.high <= MAX_BOUND:
            raise UsageError(
                f"action {self.name!r} needs finite bounds with low < high, got {self.low} and {self.high}",
                hint=f"no bound may be larger than {MAX_BOUND:g}",
            )


@dataclasses.dataclass(frozen=True)
class PolicyContract:
    """The inputs and outputs of a policy, and the conditions for which it was trained.

    Attributes:
        observation: The terms of the observation vector in their order.
        action: The entries of the action vector in their order.
        rate_hz: Policy steps per second.
        delays_s: Name -> expected delay of the training [s], e.g. ``{"sensor -> agent": 0.012}``.
        trained_s: Name -> range of the times in the training's episodes [s]: ``round_trip_delay``, from a command's
            departure to the motion in a measurement, and node -> duration of its steps. Empty: the training had no
            delays, or they are unknown.
        limits: Name -> limit that must hold while it runs, e.g. ``{"thdot_rad_s": 40.0}``.
        hashes: Name -> sha256 of the input files of the training, e.g. the log and the identified parameters.
        robot: Name of the pipeline for which it was trained; "": unknown.
        port: Port of the robot whose recording was identified, such as ``embedded``; "": none, or unknown.
    """

    observation: tuple[ObservationTerm, ...]
    action: tuple[ActionTerm, ...]
    rate_hz: float
    delays_s: Mapping[str, float] = dataclasses.field(default_factory=dict)
    trained_s: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    hashes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    robot: str = ""
    port: str = ""

    def __post_init__(self) -> None:
        if not self.observation or not self.action:
            raise UsageError("a policy needs at least one observation term and one action")
        for kind, terms in (("observation term", self.observation), ("action", self.action)):
            names = [term.name for term in terms]
            if not all(names):
                raise UsageError(f"{kind} {names.index('')} has no name")
            double = sorted({name for name in names if names.count(name) > 1})
            if double:
                raise UsageError(f"{kind} {', '.join(double)} appears more than once")
        if not RATES_HZ[0] <= self.rate_hz <= RATES_HZ[1]:
            raise UsageError(f"rate_hz must be above 0, from {RATES_HZ[0]:g} to {RATES_HZ[1]:g}, got {self.rate_hz}")

        # Rate, delays and limits.
        for name, delay in self.delays_s.items():
            if not 0 <= delay <= MAX_DELAY_S:
                raise UsageError(f"delay {name!r} must be finite, from 0 to {MAX_DELAY_S:g} s, got {delay}")
        for name, (low, high) in self.trained_s.items():
            if not 0 <= low <= high <= MAX_DELAY_S:
                raise UsageError(
                    f"times of {name!r} must be finite and in order, up to {MAX_DELAY_S:g} s, got {low} to {high} s"
                )
        for name, limit in self.limits.items():
            if not abs(limit) <= MAX_BOUND:
                raise UsageError(f"limit {name!r} must be finite and at most {MAX_BOUND:g}, got {limit}")

    @property
    def observation_size(self) -> int:
        """Number of entries of the observation vector."""
        return observation_size(self.observation)

    @property
    def observation_names(self) -> list[str]:
        """One name per entry: term, step before the newest, and index, e.g. ``past_actions[1][0]``."""
        return [
            f"{term.name}[{step}][{i}]"
            for term in self.observation
            for step in range(term.history)
            for i in range(term.size)
        ]

    def to_dict(self) -> dict[str, Json]:
        """Return the contract as plain data for JSON."""
        data: dict[str, Json] = msgspec.to_builtins(self)
        for term, entry in zip(self.observation, data["observation"], strict=True):
            data_of_bounds = {} if term.low else {"low": None, "high": None}
            entry |= {"size": term.size, **data_of_bounds}
        data["observation"] = [{n: v for n, v in entry.items() if v is not None} for entry in data["observation"]]
        return data

    @classmethod
    def from_dict(cls, data: Json) -> PolicyContract:
        """Return the contract from the data that ``to_dict`` returns.

        Raises:
            Sim2RealError: A part is missing, of the wrong type or out of its range.
        """
        contract = _read(cls, data, "contract", ("delays_s", "limits", "hashes"))
        if not all("history" in term for term in data["observation"]):
            raise _wrong("contract", "an observation term has no history")
        return contract


@dataclasses.dataclass(frozen=True)
class NetworkSpec:
    """The description of a policy's network, without its weights.

    Attributes:
        name: ``"mlp"``, ``"gru"``, or ``"package.module:Class"`` of a user's network.
        squash: Whether tanh bounds the action; otherwise it is clipped.
    """

    name: str = "mlp"
    squash: bool = False

    @property
    def built_in(self) -> bool:
        """Whether numpy runs it."""
        return self.name in BUILT_IN

    @classmethod
    def from_dict(cls, data: Json) -> NetworkSpec:
        """Return the description from its entry in ``policy.json``.

        Raises:
            Sim2RealError: A part is missing or of the wrong type.
        """
        return _read(cls, data, "network", ("name", "squash"))


def _read(kind: type[T], data: Json, what: str, needed: tuple[str, ...]) -> T:
    """Return an object from the data of a file, in which the ``needed`` entries have no default."""
    try:
        read = msgspec.convert(data, kind)
    except (msgspec.ValidationError, UnicodeError) as error:
        raise _wrong(what, str(error)) from error
    if missing := [name for name in needed if name not in data]:
        raise _wrong(what, f"{', '.join(missing)} is missing")
    return read


def _wrong(what: str, reason: str) -> Sim2RealError:
    return Sim2RealError(
        f"the policy's {what} is incomplete or wrong: {reason}", hint="export the policy again: sim2real train"
    )
