"""Scores of candidate transforms, and the best different ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_similarity, room
from scipy.spatial import cKDTree

from csgm_ros.cloud import nearest_grid
from csgm_ros.cloud.prepare import prepare
from csgm_ros.config import ScaleConfig
from csgm_ros.scale import normalizations
from csgm_ros.transform.scoring import best_distinct, scores
from csgm_ros.types import Similarity

SEEDS = st.integers(0, 2**32 - 1)
CELL, TRUNCATION, COSINE = 0.025, 0.045, float(np.cos(np.radians(40.0)))
SPACING = (
    0.05  # wider than a cell's diagonal and than the truncation: each point's cell names that point, and none else
)


def thinned(points, normals):
    kept = np.ones(len(points), bool)
    for i, j in sorted(cKDTree(points).query_pairs(SPACING)):
        kept[j] &= not kept[i]
    return points[kept], normals[kept]


def sparse_cloud():
    points = room(1, 300)
    cloud = prepare(normalizations(points, points, ScaleConfig())[0].apply(points), 0.06, 20)
    return thinned(cloud.points, cloud.normals)


def grid_of(points, normals):
    return nearest_grid.build(points, normals, CELL, 0.12)


def score(transforms, source, target, truncation=TRUNCATION, cosine=COSINE):
    transforms = np.stack([transform.matrix for transform in np.atleast_1d(transforms)])
    samples = np.arange(len(source.points)), np.arange(len(target.points))
    return scores(transforms, source, target, samples, truncation, cosine)


def shrunken(factor, centre):
    return Similarity(factor, np.eye(3), (1 - factor) * centre)


CLOUD = sparse_cloud()


@pytest.fixture
def cloud():
    return CLOUD


def test_a_cloud_lies_on_itself_perfectly(cloud):
    grid = grid_of(*cloud)
    assert score(Similarity.identity(), grid, grid)[0] == 1.0


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_score_is_a_share_and_the_truth_has_the_best(seed):
    rng = np.random.default_rng(seed)
    points, normals = CLOUD
    grid = grid_of(points, normals)
    others = [random_similarity(rng, (0.5, 2.0), 0.3) for _ in range(20)]
    found = score([Similarity.identity(), *others], grid, grid)
    assert found.min() >= 0.0
    assert found.argmax() == 0
    assert (found[1:] < 0.7).all()


@pytest.mark.parametrize('share', [0.25, 0.5, 0.9])
def test_the_smaller_side_counts(cloud, share):
    points, normals = cloud
    count = round(share * len(points))
    part, whole = grid_of(points[:count], normals[:count]), grid_of(points, normals)
    for sides in ((part, whole), (whole, part)):
        assert score(Similarity.identity(), *sides)[0] == pytest.approx(count / len(points))


def test_a_shrunken_solution_scores_lower_the_smaller_it_is(cloud):
    grid = grid_of(*cloud)
    dense = np.argmin(np.linalg.norm(cloud[0][:, None] - cloud[0], axis=2).mean(0))
    ladder = [shrunken(factor, cloud[0][dense]) for factor in (1.0, 0.97, 0.8, 0.5, 0.1, 0.001)]
    found = score(ladder, grid, grid)
    assert (np.diff(found[:4]) < 0).all()
    assert found[3:].max() < 0.1


def test_a_closer_point_counts_more(cloud):
    grid = grid_of(*cloud)
    steps = [Similarity(1.0, np.eye(3), np.array([offset, 0.0, 0.0])) for offset in (0.0, 0.004, 0.008, 0.012)]
    assert (np.diff(score(steps, grid, grid)) < 0).all()


def test_the_score_of_the_inverse_with_the_sides_exchanged_is_the_same(cloud):
    source = grid_of(*cloud)
    transform = Similarity(0.9, np.eye(3), np.array([0.01, -0.02, 0.03]))
    target = grid_of(transform.apply(cloud[0]) + 0.003, cloud[1])
    forth = score(transform, source, target)
    back = score(transform.inverse(), target, source, truncation=TRUNCATION / transform.scale)
    np.testing.assert_allclose(back, forth, rtol=1e-9)
    assert forth[0] > 0.5


def test_normals_must_agree_up_to_their_sign(cloud):
    points, normals = cloud
    grid, signs = grid_of(points, normals), np.where(np.arange(len(points)) % 2, 1.0, -1.0)[:, None]
    identity = Similarity.identity()
    assert score(identity, grid_of(points, signs * normals), grid)[0] == 1.0
    across = np.cross(normals, np.roll(normals, 1, axis=1) + np.array([0.1, 0.2, 0.3]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert score(identity, grid_of(points, across), grid)[0] == 0.0
    half = np.where(np.arange(len(points))[:, None] < len(points) // 2, normals, 0.0)  # zero: a normal that is unknown
    assert score(identity, grid_of(points, half), grid)[0] == pytest.approx(len(points) // 2 / len(points))


def test_clouds_that_do_not_meet_score_nothing(cloud):
    grid = grid_of(*cloud)
    assert score(Similarity(1.0, np.eye(3), np.full(3, 50.0)), grid, grid)[0] == 0.0


def test_no_transforms_have_no_scores(cloud):
    grid, every = grid_of(*cloud), np.arange(len(cloud[0]))
    assert scores(np.empty((0, 4, 4)), grid, grid, (every, every), TRUNCATION, COSINE).shape == (0,)


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.integers(1, 60), st.integers(1, 12), st.floats(0.01, 2.0))
def test_the_best_different_ones(seed, total, count, distance):
    rng = np.random.default_rng(seed)
    transforms = np.stack([random_similarity(rng, (0.8, 1.25), 0.5).matrix for _ in range(total)])
    transforms[total // 2 :] = transforms[: total - total // 2]  # some twice
    ranking = rng.integers(0, 10, total) / 10.0
    probe = rng.normal(size=(15, 3))
    kept = best_distinct(transforms, ranking, probe, distance, count)
    moved = np.einsum('hij,pj->hpi', transforms[:, :3, :3], probe) + transforms[:, None, :3, 3]
    apart = np.sqrt(((moved[:, None] - moved) ** 2).sum(3).mean(2))
    order = np.lexsort((np.arange(total), -ranking))
    expected = []
    for h in order:
        if len(expected) < count and all(apart[h, k] >= distance for k in expected):
            expected.append(h)
    assert kept.tolist() == expected
