"""Step 1, scale normalisation (Sec. III-A, Eq. 1)."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.outliers import without_extremes, without_far, without_isolated, without_uniform_outliers
from csgm_ros.config import Config, ScaleConfig
from csgm_ros.errors import naming
from csgm_ros.progress import Look, unhurried
from csgm_ros.types import NormalizedPair, Similarity


def radius(points: np.ndarray) -> float:
    """Return the largest distance of (N, 3) points to their centroid, the numerator of Eq. (1)."""
    return float(np.sqrt(np.max(((points - points.mean(0)) ** 2).sum(1))))


def normalize(clouds: tuple[np.ndarray, np.ndarray], config: Config, look: Look = unhurried) -> NormalizedPair:
    """Bring two clouds to radius 1, the points that would mislead Eq. (1) left out.

    Parameters
    ----------
    clouds : pair of (N, 3) ndarray
        Source and target, finite points in their own units.
    look : callable, optional
        Asked after every step.

    Notes
    -----
    The paper measures the radius on all points. One outlier far away then changes every length that follows, so the
    robust profile leaves outliers out before (``preprocess.outlier_factor``).
    """
    factor = config.preprocess.outlier_factor
    if factor <= 0.0:
        return NormalizedPair(clouds, normalizations(*clouds, config.scale))
    kept, dense = [], []
    for name, cloud in zip(('source', 'target'), clouds, strict=True):
        with naming(name):
            near = without_extremes(cloud)
            look()
            kept.append(without_uniform_outliers(near))
            look()
            dense.append(without_isolated(kept[-1], factor))
            look()
    units = normalizations(dense[0], dense[1], config.scale)
    return NormalizedPair((without_far(kept[0], units[0]), without_far(kept[1], units[1])), units)


def normalizations(source: np.ndarray, target: np.ndarray, config: ScaleConfig) -> tuple[Similarity, Similarity]:
    """Return the transforms that centre two clouds and give both radius 1.

    Doing so to both divides them by the scale of Eq. (1) and, beyond it, frees every later stage of the clouds'
    units and origins. In rigid mode the clouds share a unit already, and both are divided by one length between
    their radii.

    Parameters
    ----------
    source, target : (N, 3), (M, 3) ndarray
        Finite points, outliers left out.
    config : ScaleConfig
        ``estimate_scale`` false is the rigid mode.
    """
    radii = np.array([radius(source), radius(target)])
    if not config.estimate_scale:
        radii[:] = np.sqrt(radii.prod())
    first, second = (
        Similarity(1.0 / length, np.eye(3), -points.mean(0) / length)
        for points, length in zip((source, target), radii, strict=True)
    )
    return first, second


def search_range(
    source: Similarity, target: Similarity, config: ScaleConfig, factor: float, relative: float = 1.0
) -> tuple[float, float]:
    """Return the smallest and largest scale to search between the normalised clouds.

    Eq. (1) says 1; its error reaches 42 % (partial overlap, outliers), so scales up to ``factor`` times or by
    ``1 / relative`` are searched, as far as the bounds of ``config`` allow; where these lie outside, they win. With a
    prior, its bounds are searched, and Eq. (1) is not asked.
    """
    if not config.estimate_scale:
        return 1.0, 1.0
    unit = target.scale / source.scale
    allowed = config.bounds[0] * unit, config.bounds[1] * unit
    if config.prior > 0.0:
        return allowed
    low, high = max(allowed[0], 1.0 / (relative * factor)), min(allowed[1], factor / relative)
    return (low, high) if low < high else allowed
