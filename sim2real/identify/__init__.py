"""Identification: parameters, residuals, search, uncertainty."""

from typing import TYPE_CHECKING, Any

from sim2real import callable_package

if TYPE_CHECKING:
    from sim2real.identify.search.minimum import minimise as minimise

__all__ = ["minimise"]

callable_package(__name__)


def __getattr__(name: str) -> Any:
    """Import a public function on first use."""
    if name in __all__:
        from sim2real.identify.search import minimum

        return getattr(minimum, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
