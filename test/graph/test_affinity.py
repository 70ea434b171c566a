"""Affinities K_p and K_q, Eq. (2) and Eq. (3)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csgm_ros.errors import InputError
from csgm_ros.graph.affinity import affinity

SEEDS = st.integers(0, 2**32 - 1)
KINDS = st.sampled_from(['linear', 'gaussian'])


def descriptors(seed, count=12, width=5):
    rng = np.random.default_rng(seed)
    return rng.random((count, width)), rng.random((count + 3, width))


@settings(deadline=None)
@given(SEEDS, KINDS)
def test_lies_between_0_and_1_and_falls_with_the_distance(seed, kind):
    first, second = descriptors(seed)
    found = affinity(first, second, kind, 0.5)
    distances = np.linalg.norm(first[:, None] - second, axis=2)
    assert found.shape == (12, 15)
    assert found.min() >= 0.0
    assert found.max() <= 1.0
    assert (np.diff(found.ravel()[np.argsort(distances.ravel())]) <= 1e-12).all()


@settings(deadline=None)
@given(SEEDS, KINDS)
def test_equal_descriptors_have_affinity_1_and_both_directions_agree(seed, kind):
    first, second = descriptors(seed)
    np.testing.assert_allclose(np.diag(affinity(first, first, kind, 0.5)), 1.0)
    np.testing.assert_allclose(affinity(first, second, kind, 0.5).T, affinity(second, first, kind, 0.5), atol=1e-12)


@settings(deadline=None)
@given(SEEDS, KINDS, st.floats(1e-3, 1e3))
def test_the_unit_of_the_descriptors_does_not_matter(seed, kind, factor):
    first, second = descriptors(seed)
    expected = affinity(first, second, kind, 0.5)
    np.testing.assert_allclose(affinity(factor * first, factor * second, kind, 0.5), expected, atol=1e-9)


def test_the_two_formulas():
    first, second = np.array([[0.0], [1.0]]), np.array([[0.0], [2.0], [4.0]])  # distances 0, 2, 4 and 1, 1, 3
    np.testing.assert_allclose(affinity(first, second, 'linear', 1.0), [[1, 0.5, 0], [0.75, 0.75, 0.25]])
    expected = np.exp(-(np.array([[0, 2, 4], [1, 1, 3]]) ** 2) / (2 * (0.5 * 1.5) ** 2))
    np.testing.assert_allclose(affinity(first, second, 'gaussian', 0.5), expected)


@pytest.mark.parametrize('kind', ['linear', 'gaussian'])
def test_nothing_to_compare(kind):
    same = np.ones((4, 3))
    assert (affinity(same, same, kind, 0.5) == 1.0).all()
    assert affinity(np.empty((0, 3)), same, kind, 0.5).shape == (0, 4)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_descriptors_that_are_not_finite_are_refused(bad):
    first, second = descriptors(0)
    first[3, 1] = bad
    with pytest.raises(InputError, match='finite'):
        affinity(first, second, 'gaussian', 0.5)
