"""Proximal policy optimisation (PPO) of several seeds in one compiled program."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim2real.train.ppo.trainer import train as train

__all__ = ["train"]


def __getattr__(name: str) -> Any:
    """Import ``train`` on first use: it imports JAX."""
    if name in __all__:
        from sim2real.train.ppo import trainer

        return getattr(trainer, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
