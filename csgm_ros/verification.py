"""Which of many candidate transforms is right, and is it right at all (Sec. III-E, extended).

The paper trusts one transform from RANSAC and ICP. Here every hypothesis is scored by how well the source lies
on the target *and* the target on the source, and the smaller of the two counts: a one-sided score, or the sum,
prefers shrunken solutions. Points must agree in place and in normal, and a closer point counts more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from csgm_ros.config import VerificationConfig
from csgm_ros.nearest import NearestGrid, lookup
from csgm_ros.types import PreparedCloud, Similarity, Verdict


def scores(
    transforms: np.ndarray,
    source: NearestGrid,
    target: NearestGrid,
    samples: tuple[np.ndarray, np.ndarray],
    gate: float,
    min_cosine: float,
) -> np.ndarray:
    """Score transforms by how closely the two clouds lie on each other, the smaller side counting.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
        Similarity matrices, source to target.
    samples : pair of index arrays
        Points of source and target that are looked at.
    gate : float
        Distance in target units at which a point counts nothing; one at distance 0 counts 1.
    min_cosine : float
        Smallest cosine between the normals, up to their sign.

    Returns
    -------
    (H,) ndarray
        In [0, 1].
    """
    forth, back = np.empty(len(transforms)), np.empty(len(transforms))
    chosen_source = source.points[samples[0]], source.normals[samples[0]]
    chosen_target = target.points[samples[1]], target.normals[samples[1]]
    _closeness(*chosen_source, transforms, target, gate, min_cosine, False, forth)
    _closeness(*chosen_target, _inverses(transforms), source, gate, min_cosine, True, back)
    return np.minimum(forth, back)


@numba.njit(cache=True, nogil=True)
def _closeness(points, normals, transforms, grid, gate, min_cosine, backward, out):
    """Write the mean closeness under each transform; ``gate`` is in target units also when going backward."""
    for h in range(len(transforms)):
        m = transforms[h]
        scale = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
        reach = gate * scale if backward else gate
        total = 0.0
        for p in range(len(points)):
            a, b, c = points[p, 0], points[p, 1], points[p, 2]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
            q = lookup(grid.index, grid.origin, grid.cell, x, y, z)
            if q < 0:
                continue
            dx, dy, dz = x - grid.points[q, 0], y - grid.points[q, 1], z - grid.points[q, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared >= reach * reach:
                continue
            a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
            product = (
                (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) * grid.normals[q, 0]
                + (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c) * grid.normals[q, 1]
                + (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c) * grid.normals[q, 2]
            )
            if abs(product) >= min_cosine * scale:
                total += 1.0 - np.sqrt(squared) / reach
        out[h] = total / len(points)


@numba.njit(cache=True, nogil=True)
def _inverses(transforms):
    out = np.zeros_like(transforms)
    for h in range(len(transforms)):
        m = transforms[h]
        squared = m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2
        for i in range(3):
            for j in range(3):
                out[h, i, j] = m[j, i] / squared
        for i in range(3):
            out[h, i, 3] = -(out[h, i, 0] * m[0, 3] + out[h, i, 1] * m[1, 3] + out[h, i, 2] * m[2, 3])
        out[h, 3, 3] = 1.0
    return out


def best_distinct(
    transforms: np.ndarray, ranking: np.ndarray, probe: np.ndarray, distance: float, count: int
) -> np.ndarray:
    """Return the indices of the ``count`` best transforms no two of which move ``probe`` alike.

    Parameters
    ----------
    transforms : (H, 4, 4) ndarray
    ranking : (H,) ndarray
        Larger is better; ties keep the given order.
    probe : (P, 3) ndarray
        Source points.
    distance : float
        RMS displacement of the probe below which two transforms are the same.
    """
    images = np.empty((count, *probe.shape))
    kept: list[int] = []
    for h in np.argsort(-ranking, kind='stable'):
        image = probe @ transforms[h, :3, :3].T + transforms[h, :3, 3]
        if kept and ((images[: len(kept)] - image) ** 2).sum(2).mean(1).min() < distance**2:
            continue
        images[len(kept)] = image
        kept.append(h)
        if len(kept) == count:
            break
    return np.array(kept, int)


@dataclass(frozen=True)
class Fit:
    """How two clouds lie on each other under one transform, with exact nearest points.

    Attributes
    ----------
    fitness_source, fitness_target : float
        Share of either side within the inlier distance of the other, normals agreeing.
    closeness : float
        The smaller side's mean closeness, 1 at distance 0 and 0 at the inlier distance.
    rmse : float
        RMS distance of the inliers of both sides, target units.
    """

    fitness_source: float
    fitness_target: float
    closeness: float
    rmse: float


class Judge:
    """Measures transforms on two finely sampled clouds and passes the verdict."""

    def __init__(
        self, source: PreparedCloud, target: PreparedCloud, config: VerificationConfig, rng: np.random.Generator
    ):
        self._source, self._target, self._config = source, target, config
        self._trees = cKDTree(source.points), cKDTree(target.points)
        self._samples = [rng.permutation(len(cloud.points))[: config.fine_samples] for cloud in (source, target)]
        self._min_cosine = np.cos(np.radians(config.max_normal_angle))

    def fit(self, transform: Similarity) -> Fit:
        """Measure one transform between the prepared clouds."""
        forth = self._one_side(transform, self._source, self._target, self._trees[1], self._samples[0])
        back = self._one_side(transform.inverse(), self._target, self._source, self._trees[0], self._samples[1])
        back = back * transform.scale
        gate = self._config.inlier_distance
        inliers = np.concatenate([forth[forth < gate], back[back < gate]])
        return Fit(
            float((forth < gate).mean()),
            float((back < gate).mean()),
            float(min(np.clip(1.0 - side / gate, 0.0, None).mean() for side in (forth, back))),
            float(np.sqrt((inliers**2).mean())) if len(inliers) else float('inf'),
        )

    def _one_side(self, transform, moving, fixed, tree, chosen):
        # distance to the nearest point, infinite where the normals disagree
        distance, nearest = tree.query(transform.apply(moving.points[chosen]), workers=-1)
        turned = moving.normals[chosen] @ transform.rotation.T
        agree = np.abs((turned * fixed.normals[nearest]).sum(1)) >= self._min_cosine
        return np.where(agree, distance, np.inf)

    def verdict(self, fit: Fit, rivals: list[float], radius: float) -> Verdict:
        """Accept or reject a measured transform.

        Parameters
        ----------
        fit : Fit
            Of the winner.
        rivals : list of float
            Closeness of every *different* hypothesis.
        radius : float
            Of the target, in its own unit, for the RMSE.
        """
        smaller = min(fit.fitness_source, fit.fitness_target)
        margin = fit.closeness / max(max(rivals), 1e-9) if rivals else float('inf')
        accepted, reason = self._decide(smaller, margin)
        return Verdict(accepted, reason, fit.fitness_source, fit.fitness_target, fit.rmse * radius, float(margin))

    def _decide(self, smaller: float, margin: float) -> tuple[bool, str]:
        config = self._config
        if smaller < config.min_fitness:
            return False, (
                f'too little overlap: only {smaller:.0%} of one cloud lies on the other '
                f'(at least {config.min_fitness:.0%} is asked for)'
            )
        if margin < config.min_margin:
            return False, (
                f'ambiguous: a different transform fits almost as well (margin {margin:.2f}, at least '
                f'{config.min_margin:.2f} is asked for); the scene may be symmetric or flat'
            )
        return True, f'{smaller:.0%} of the smaller side fits, {margin:.2f} times as well as any different transform'
