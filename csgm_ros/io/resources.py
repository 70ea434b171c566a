"""Where the configuration files lie: in a checkout, a pip install or a colcon install."""

from __future__ import annotations

from pathlib import Path

from csgm_ros.errors import InputError


def config_file(name: str) -> Path:
    """Return the path of a file of ``config/``.

    Raises
    ------
    InputError
        When this install lacks it.
    """
    package = Path(__file__).parents[1]
    for start in (package, package.resolve()):
        checkout = start.parent / 'config' / name
        if checkout.is_file() and (start.parent / 'package.xml').is_file():
            return checkout
        for prefix in start.parents:
            installed = prefix / 'share' / 'csgm_ros' / 'config' / name
            if installed.is_file():
                return installed
    raise InputError(f'{name} is not part of this install of csgm_ros; install the package again')
