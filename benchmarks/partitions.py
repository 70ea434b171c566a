"""How alike two partitions of the same points are."""

from __future__ import annotations

import numpy as np


def contingency(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how many points have each pair of (N,) labels, (n1, n2)."""
    rows, first = np.unique(first, return_inverse=True)
    columns, second = np.unique(second, return_inverse=True)
    counts = np.bincount(first * len(columns) + second, minlength=len(rows) * len(columns))
    return counts.reshape(len(rows), len(columns))


def adjusted_rand(first: np.ndarray, second: np.ndarray) -> float:
    """Return the adjusted Rand index (Hubert and Arabie 1985): 1 for equal partitions, 0 on average by chance."""

    def pairs(counts: np.ndarray) -> float:
        return float((counts * (counts - 1.0)).sum()) / 2

    table = contingency(first, second)
    both, rows, columns = pairs(table), pairs(table.sum(1)), pairs(table.sum(0))
    expected = rows * columns / pairs(np.array([len(first)]))
    largest = (rows + columns) / 2
    return 1.0 if largest == expected else (both - expected) / (largest - expected)


def undersegmentation(labels: np.ndarray, reference: np.ndarray) -> float:
    """Return the share of points outside the reference segment that most of their own segment lies in, [0, 1)."""
    return 1.0 - float(contingency(labels, reference).max(1).sum()) / len(labels)
