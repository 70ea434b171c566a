"""Geometry of similarity transforms, ``x_target = s R x_source + t``: the least-squares fit and the rotation error."""

from __future__ import annotations

import numpy as np

from csgm_ros.types import Similarity


def umeyama(source: np.ndarray, target: np.ndarray, *, estimate_scale: bool = True) -> Similarity:
    """Fit the similarity that maps matched points onto each other in the least-squares sense.

    Parameters
    ----------
    source, target : (N, 3) ndarray
        Matched points, N >= 3 and not all on one line.
    estimate_scale : bool, optional
        False fits a rigid transform (s = 1).

    Returns
    -------
    Similarity

    References
    ----------
    .. [1] S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
       IEEE TPAMI 13(4), 1991.
    """
    scales, rotations, translations = umeyama_many(source[None], target[None], estimate_scale=estimate_scale)
    return Similarity(float(scales[0]), rotations[0], translations[0])


def umeyama_many(
    source: np.ndarray, target: np.ndarray, *, estimate_scale: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit many sets of matched points at once, see :func:`umeyama`.

    Parameters
    ----------
    source, target : (n, k, 3) ndarray
        n sets of k matched points.

    Returns
    -------
    scales : (n,) ndarray
    rotations : (n, 3, 3) ndarray
    translations : (n, 3) ndarray
    """
    mean_source, mean_target = source.mean(1), target.mean(1)
    centred = source - mean_source[:, None]
    u, singular, vt = np.linalg.svd(np.einsum('nki,nkj->nij', target - mean_target[:, None], centred))
    flip = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0.0, -1.0, 1.0)  # a mirror image is no rotation
    u[:, :, 2] *= flip[:, None]
    rotations = u @ vt
    scales = np.ones(len(source))
    if estimate_scale:
        spread = (centred**2).sum((1, 2))
        np.divide(singular[:, 0] + singular[:, 1] + flip * singular[:, 2], spread, out=scales, where=spread > 0.0)
    translations = mean_target - scales[:, None] * np.einsum('nij,nj->ni', rotations, mean_source)
    return scales, rotations, translations
