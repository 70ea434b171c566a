"""Step 3, affinities K_p and K_q: how alike two nodes or two edges are (Eq. 2 and Eq. 3)."""

from __future__ import annotations

import numpy as np

from csgm_ros.errors import InputError


def affinity(first: np.ndarray, second: np.ndarray, similarity: str, sigma: float) -> np.ndarray:
    """Return the similarity of every row of one array with every row of another.

    Parameters
    ----------
    first, second : (n1, d), (n2, d) ndarray
        Descriptors: of nodes for K_p, edge descriptors for K_q.
    similarity : {'linear', 'gaussian'}
        ``1 - D / max(D)`` or ``exp(-D^2 / (2 (sigma median(D))^2))`` of the distances D.
    sigma : float
        Width of the Gaussian, in medians of D.

    Returns
    -------
    (n1, n2) ndarray
        In [0, 1], 1 for equal descriptors.

    Notes
    -----
    The paper sets K_p and K_q to the normalised *distances*, and then maximises an objective that grows with
    them; what is meant must be their complement. The Gaussian of the robust profile does not depend on the one
    largest distance.
    """
    from scipy.spatial.distance import cdist

    distances = cdist(first, second)
    if not np.isfinite(distances).all():
        raise InputError('descriptors that are not finite have no similarity')
    if similarity == 'gaussian':
        width = sigma * float(np.median(distances)) if distances.size else 0.0
        return np.exp(-(distances**2) / (2.0 * width**2)) if width > 0.0 else np.ones_like(distances)
    largest = distances.max(initial=0.0)
    return 1.0 - distances / largest if largest > 0.0 else np.ones_like(distances)
