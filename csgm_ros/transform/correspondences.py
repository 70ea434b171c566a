"""Putative correspondences: which nodes or keypoints of two clouds may belong together, most of them wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from csgm_ros.progress import Look, unhurried


class Correspondences(NamedTuple):
    """Putative correspondences; a point may occur in many.

    Attributes
    ----------
    source, target : (k, 3) ndarray
        Positions.
    source_normals, target_normals : (k, 3) ndarray
        Unit normals of arbitrary sign.
    """

    source: np.ndarray
    target: np.ndarray
    source_normals: np.ndarray
    target_normals: np.ndarray


def most_similar(affinities: np.ndarray, count: int) -> np.ndarray:
    """Return every row with its ``count`` most similar columns, (k, 2) index pairs."""
    count = min(count, affinities.shape[1])
    best = np.argsort(-affinities, axis=1, kind='stable')[:, :count]
    return np.column_stack([np.repeat(np.arange(len(affinities)), count), best.ravel()])


def nearest_both_ways(source: np.ndarray, target: np.ndarray, count: int, look: Look = unhurried) -> np.ndarray:
    """Return the pairs in which one feature is among the ``count`` nearest of the other, (k, 2) index pairs."""
    forth = _nearest(source, target, count)
    look()
    back = _nearest(target, source, count)
    return np.unique(np.concatenate([forth, back[:, ::-1]]), axis=0)


def _nearest(features: np.ndarray, others: np.ndarray, count: int) -> np.ndarray:
    from scipy.spatial import cKDTree

    count = min(count, len(others))
    _, nearest = cKDTree(others).query(features, k=count)
    return np.column_stack([np.repeat(np.arange(len(features)), count), np.reshape(nearest, -1)])
