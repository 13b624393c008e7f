"""How a field of a configuration appears on the command line, where its type alone does not decide it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """Marks a field: ``port: Annotated[str | None, Flag("PORT")] = None``.

    Attributes:
        metavar: Placeholder of the value in ``--help``; "": the type's.
        positional: Whether the value stands without a flag.
        flat: Whether the flags of a nested configuration have no prefix.
        also: A second name, such as ``--like``.
        alone: Value of a flag that is written without one; None: it needs a value.
    """

    metavar: str = ""
    positional: bool = False
    flat: bool = False
    also: str = ""
    alone: str | None = None
