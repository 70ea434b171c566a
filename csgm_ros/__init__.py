"""CSGM: registration of point clouds from different kinds of sensor by their structure graphs."""

from importlib import import_module

_HOMES = {
    'register': 'csgm_ros.registration',
    'Config': 'csgm_ros.config',
    'profile': 'csgm_ros.config',
    'Estimate': 'csgm_ros.types',
    'Prior': 'csgm_ros.types',
    'RegistrationResult': 'csgm_ros.types',
    'Session': 'csgm_ros.tracking.session',
    'Similarity': 'csgm_ros.types',
    'Verdict': 'csgm_ros.types',
}
__all__ = [
    'Config',
    'Estimate',
    'Prior',
    'RegistrationResult',
    'Session',
    'Similarity',
    'Verdict',
    'profile',
    'register',
]


def __getattr__(name: str):
    """Import on first use, so that `import csgm_ros` stays cheap (scipy, numba and Open3D are not)."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(_HOMES[name]), name)
