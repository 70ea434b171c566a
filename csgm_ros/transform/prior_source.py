"""Hypotheses from a prior: transforms drawn from what is expected, the expected one first."""

from __future__ import annotations

import numpy as np

from csgm_ros.config import HypothesesConfig
from csgm_ros.transform.sources import StructurePair

DRAWN = 300


def propose(pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return (H, 4, 4) transforms about the source's centre, none where nothing is expected."""
    from scipy.spatial.transform import Rotation

    if pair.prior is None:
        return np.empty((0, 4, 4))
    expected, (shift, angle, growth) = pair.prior.transform, pair.prior.sigma
    vectors, shifts, growths = rng.normal(size=(DRAWN, 3)), rng.normal(size=(DRAWN, 3)), rng.normal(size=DRAWN)
    vectors[0], shifts[0], growths[0] = 0.0, 0.0, 0.0
    turned = Rotation.from_rotvec(np.radians(angle) * vectors).as_matrix() @ expected.rotation
    scales = np.clip(expected.scale * np.exp(growth * growths), *pair.wide_scales)
    drawn = np.tile(np.eye(4), (DRAWN, 1, 1))
    drawn[:, :3, :3] = scales[:, None, None] * turned
    drawn[:, :3, 3] = expected.translation + shift * shifts
    return drawn
