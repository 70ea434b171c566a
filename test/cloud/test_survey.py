"""What is seen of a cloud that is not held as a whole, against the whole."""

import numpy as np
import pytest
from scenes import room
from scipy.spatial import cKDTree

from csgm_ros.cloud import survey as module
from csgm_ros.cloud.survey import survey
from csgm_ros.errors import DegenerateCloudError

CLOUD = room(0, density=3000)


def parts(points):
    return np.array_split(points, 7)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(module, 'IN_A_BLOCK', 200)


@pytest.mark.parametrize('threads', [1, 2])
def test_places_are_whole_where_neighbours_are_asked_for(threads):
    dirty = np.random.default_rng(0).permutation(np.vstack([CLOUD, np.full((5, 3), np.nan)]))
    most = len(CLOUD) // 5
    seen = survey(parts(dirty), len(dirty), most, threads)
    assert (seen.total, seen.finite) == (len(dirty), len(CLOUD))
    np.testing.assert_array_equal(seen.low, CLOUD.min(0))
    np.testing.assert_array_equal(seen.high, CLOUD.max(0))
    assert most / 4 < len(seen.points) <= most
    assert most / 2 < len(seen.drawn) <= most + 7
    assert most / 3 < len(seen.places) <= 2 * most
    assert set(map(tuple, seen.places)) <= set(map(tuple, CLOUD))
    inside = seen.places[seen.inner]
    assert len(inside) > 100
    found, right = (cKDTree(points).query(inside, k=2)[0][:, 1] for points in (seen.places, CLOUD))
    assert (found == right).mean() > 0.98
    assert np.median(found) == pytest.approx(np.median(cKDTree(CLOUD).query(CLOUD, k=2)[0][:, 1]), rel=0.1)


def test_a_small_cloud_is_taken_as_it_is():
    seen = survey(parts(CLOUD), len(CLOUD), len(CLOUD))
    assert seen.points is seen.places is seen.drawn
    np.testing.assert_array_equal(seen.points, CLOUD)
    assert seen.inner.all()


def test_points_crowded_in_one_place_do_not_fill_the_memory():
    crowd = np.random.default_rng(0).normal(scale=1e-6, size=(4 * len(CLOUD), 3))
    seen = survey(parts(np.vstack([CLOUD, crowd])), 5 * len(CLOUD), 1000)
    assert 0 < len(seen.places) <= 2000
    with pytest.raises(DegenerateCloudError, match='no finite point'):
        survey(parts(np.full((100, 3), np.inf)), 100, 10)
