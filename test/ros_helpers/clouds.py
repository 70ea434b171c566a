"""Clouds for the node: one scene that registers in seconds, and messages in every layout."""

from functools import cache

import numpy as np

from csgm_ros.demo.simulation import simulate


@cache
def easy_pair():
    """(source, target, truth): a simulated Kinect frame and every second point of it in another unit and pose.

    The truth is exact and the overlap complete: what the node does with a result is tested, not the method.
    """
    pair = simulate(0, height=120, width=160, sfm_points=2000)
    target = pair.target.reshape(-1, 3)[np.isfinite(pair.target.reshape(-1, 3)).all(axis=1)].astype(float)
    noise = np.random.default_rng(1).normal(scale=0.002, size=target[::2].shape)
    return pair.truth.inverse().apply(target[::2] + noise), target, pair.truth


@cache
def unrelated_pair():
    """(source, target) that have nothing in common: a ball of noise and a wavy sheet."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4000, 3))
    x, y = rng.uniform(-1, 1, (2, 4000))
    return ball, np.stack([x, y, 0.1 * np.sin(9 * x) * np.cos(7 * y)], axis=1)


def displacement(estimate, truth, source):
    """Return the mean distance between where both transforms put the source, target units."""
    return float(np.linalg.norm(estimate.apply(source) - truth.apply(source), axis=1).mean())
