"""What a worker does: one pair, from two files to one row."""

from __future__ import annotations

import dataclasses
import functools
import json
import platform
import time
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from csgm_ros.batch.pairs import Pair
from csgm_ros.errors import CsgmError

if TYPE_CHECKING:
    import numpy as np

    from csgm_ros.types import RegistrationResult

LIBRARIES = ('numpy', 'scipy', 'numba', 'open3d-cpu', 'open3d')


def register_pair(pair: Pair, threads: int, pages: str = '') -> dict:
    """Register one pair of files and return its row; input that cannot be registered is a result too.

    Parameters
    ----------
    pair : Pair
    threads : int
        Threads that the registration may take, where the pair's parameters do not say.
    pages : str, optional
        Folder for a page of the result, ``KEY.html``; default: none is written.
    """
    import numpy as np

    from csgm_ros.config import profile, replaced
    from csgm_ros.io.files import read_points
    from csgm_ros.registration import register

    config = replaced(profile(pair.profile), {'threads': threads, **dict(pair.changes)})
    start = time.perf_counter()
    try:
        most = config.preprocess.max_points
        source, target = (read_points(path, most, threads) for path in (pair.source, pair.target))
        read_seconds = time.perf_counter() - start
        result = register(source, target, config, seed=pair.seed, details=bool(pages), prior=pair.prior)
        if pages and result.details is not None:
            _write_page(Path(pages, f'{pair.key}.html'), pair, result, source, target)
    except CsgmError as error:
        return {**failed(pair, str(error)), 'worker': platform.node(), 'versions': versions()}
    # where the clouds match, as far as the time budget reached
    nodes = np.zeros((1, 3)) if result.source_graph is None else result.source_graph.nodes
    center = nodes.mean(0)
    verdict = {name: value for name, value in vars(result.verdict).items() if isinstance(value, (int, float))}
    verdict.pop('accepted')
    return {
        **_head(pair),
        'accepted': bool(result.accepted),
        'failed': False,
        'reason': result.reason,
        'T_target_source': result.T_target_source.ravel().tolist(),
        'scale': float(result.scale),
        **{name: float(verdict[name]) for name in ('fitness_source', 'fitness_target', 'inlier_rmse', 'margin')},
        'evidence': {name: float(value) for name, value in verdict.items()},
        'source_center': center.tolist(),
        'source_spread': float(np.sqrt(((nodes - center) ** 2).sum(1).mean())),
        'timings': dict(result.timings),
        'seconds': float(result.seconds),
        'read_seconds': read_seconds,
        'versions': versions(),
        'worker': platform.node(),
        'finished': _now(),
    }


def _write_page(path: Path, pair: Pair, result: RegistrationResult, source: np.ndarray, target: np.ndarray) -> None:
    from csgm_ros.io.cloud_file import CloudFile
    from csgm_ros.visual.report import write_report
    from csgm_ros.visual.report_data import report_data

    names = Path(pair.source).name, Path(pair.target).name
    data = report_data(result, CloudFile(source, None), CloudFile(target, None), names)
    write_report(path, dataclasses.replace(data, facts={'pair': pair.id, **data.facts}))


def failed(pair: Pair, reason: str) -> dict:
    """Return the row of a pair that has no result."""
    return {**_head(pair), 'accepted': False, 'failed': True, 'reason': reason, 'finished': _now()}


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions that a result may depend on."""
    found = {'python': platform.python_version()}
    for name in ('csgm_ros', *LIBRARIES):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # Open3D comes under two names
    return found


def _head(pair: Pair) -> dict:
    return {
        'key': pair.key,
        **{name: getattr(pair, name) for name in ('id', 'source', 'target', 'seed', 'profile')},
        'parameters': json.dumps(dict(pair.changes)),
        'parameters_hash': pair.parameters_hash,
        'initial': list(pair.initial) or None,
        'initial_sigma': list(pair.initial_sigma) or None,
    }


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec='seconds')
