"""What every source of hypotheses gets to see, and the one signature that all of them have.

A source is a function ``propose(pair, config, rng) -> (H, 4, 4) ndarray`` in a file of its own, registered by a line
in :data:`csgm_ros.config.HYPOTHESIS_SOURCES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from csgm_ros.config import HYPOTHESIS_SOURCES, HypothesesConfig
from csgm_ros.progress import Look, unhurried
from csgm_ros.schema import implementation
from csgm_ros.transform.ladder import Ladder
from csgm_ros.types import Prior, Structure


@dataclass(frozen=True, eq=False)
class StructurePair:
    """All that is known of two clouds before a transform is.

    Attributes
    ----------
    source, target : Structure
        In the normalised frames, between which hypotheses are proposed.
    matches : (k, 2) int ndarray
        Matched nodes (source, target): the non-zeros of X.
    node_affinity : (n1, n2) ndarray
        K_p, Eq. (2).
    scales : tuple of float
        Smallest and largest scale to propose; equal ones fix it.
    keypoints : callable
        Returns the keypoints of source and target, described when first asked for.
    ladder : Ladder
        The clouds in working cells.
    wide_scales : tuple of float
        As ``scales``, for sources that do not need the clouds to be about equally large.
    found : callable
        Returns the (F, 4, 4) finalists of other sources so far.
    prior : Prior or None
        Where the transform is expected, between the normalised frames.
    look : callable
        To be asked between the steps of a source that takes long.
    """

    source: Structure
    target: Structure
    matches: np.ndarray
    node_affinity: np.ndarray
    scales: tuple[float, float]
    keypoints: Callable[[], tuple[Any, Any]]
    ladder: Ladder
    wide_scales: tuple[float, float]
    found: Callable[[], np.ndarray]
    prior: Prior | None = None
    look: Look = unhurried


def propose(name: str, pair: StructurePair, config: HypothesesConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the (H, 4, 4) hypotheses of one source, similarity matrices between the normalised clouds."""
    return implementation(HYPOTHESIS_SOURCES[name])(pair, config, rng)
