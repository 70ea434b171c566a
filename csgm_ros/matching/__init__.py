"""Step 4: enhanced factorised graph matching (Sec. III-D)."""

from importlib import import_module

__all__ = ['match_graphs']


def __getattr__(name: str):
    """Import on first use: the kernels need numba, which is slow to import."""
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module('csgm_ros.matching.match'), name)
