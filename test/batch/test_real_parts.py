"""Parts of a real cloud in units of their own, registered and aligned with a wrong pair among them."""

import pytest

pytest.importorskip('pyarrow')
from benchmarks.pose_graph import inconsistent, slabs, solved
from csgm_ros.io.files import read_cloud


def test_a_planted_pair_is_named_and_every_part_lands_where_it_belongs(shared, tmp_path):
    points = read_cloud(shared / 'data/kinect_sfm/kitchen_000_120/kinect.ply').points[::8]
    rows, planted, _, errors = solved(slabs(points, 5, 0.6), 2, tmp_path)
    assert len(planted) == 1
    assert all(row['accepted'] for row in rows)
    assert inconsistent(tmp_path) == planted
    assert len(errors) == 5
    assert max(off for off, _ in errors.values()) < 0.01  # metres
    assert all(factor == pytest.approx(1.0, abs=0.003) for _, factor in errors.values())
