"""Real clouds of one kitchen, SfM and Kinect, whose truth is known to a few centimetres."""

import json
from functools import cache

import numpy as np
import pytest

from csgm_ros import register
from csgm_ros.attempts import Attempt
from csgm_ros.io.files import read_cloud
from csgm_ros.types import Similarity, rotation_angle

PAIRS = ('crop_chair_000', 'crop_table_195', 'kitchen_000_120')


@pytest.fixture(scope='module')
def registered(shared):
    @cache
    def run(name):
        folder = shared / 'data' / 'kinect_sfm' / name
        source, target = (read_cloud(folder / file).points for file in ('sfm.ply', 'kinect.ply'))
        truth = Similarity.from_matrix(json.loads((folder / 'gt.json').read_text())['sfm_to_kinect'])
        return source, target, truth, register(source, target)

    return run


@pytest.mark.parametrize('name', PAIRS)
def test_a_real_pair_is_registered(registered, name):
    source, _, truth, result = registered(name)
    assert result.accepted, result.reason
    offsets = result.transform.apply(source) - truth.apply(source)
    assert np.linalg.norm(offsets, axis=1).mean() < 0.10  # metres
    assert np.degrees(rotation_angle(result.transform.rotation.T @ truth.rotation)) < 5.0
    assert abs(np.log(result.scale / truth.scale)) < 0.06


@pytest.mark.parametrize('name', PAIRS)
def test_the_matches_that_people_are_shown_agree_with_the_answer(registered, name):
    result = registered(name)[3]
    assert result.match_inliers.mean() > 0.9
    assert result.match_inliers.sum() > 0.3 * len(result.source_graph.nodes)  # less where an attempt cut finer nodes
    assert result.unguided_inliers.mean() > 0.5  # of those that graph matching found without knowing it


def test_different_places_are_not_mistaken_for_each_other(registered, monkeypatch):
    monkeypatch.setattr('csgm_ros.registration.schedule', lambda *_: [Attempt()])  # all attempts take long
    source = registered('crop_chair_000')[0]
    target = registered('crop_table_195')[1]
    assert not register(source, target).accepted
