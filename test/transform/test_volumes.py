"""A part that shares no plane with the whole, only directions: found by its volume."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_planes import hall, view

from csgm_ros.transform import volumes
from csgm_ros.transform.ladder import Ladder
from csgm_ros.transform.planes import finalists
from csgm_ros.types import Similarity

TURN = Rotation.from_euler('xyz', (40, -70, 110), degrees=True).as_matrix()
TRUTH = Similarity(1.0, TURN, np.array([5.0, -3.0, 2.0]))
NOTHING = np.empty((0, 4, 4))


@pytest.fixture(scope='module')
def ladder():
    """What stands in a corner of a hall, without its floor and its wall."""
    points = view(hall(1))
    above = points[(points[:, 2] > 0.25) & (points[:, 1] > 0.25)]
    return Ladder(TRUTH.inverse().apply(above), hall(2), 0)


def test_a_part_is_found_by_what_stands_on_the_floor(ladder):
    assert volumes.found(ladder) is volumes.found(ladder)
    best = Similarity.from_matrix(volumes.found(ladder)[0])
    assert best.displacement(TRUTH, ladder.flights[0].part.points) < 0.15


def test_planes_alone_do_not_find_it(ladder):
    best = Similarity.from_matrix(finalists(ladder, np.ones(1), NOTHING)[0])
    assert best.displacement(TRUTH, ladder.flights[0].part.points) > 1.0


@pytest.mark.parametrize('turned', range(4))
def test_a_half_turn_is_read_off_the_spectrum(turned):
    rng = np.random.default_rng(0)
    points = rng.uniform(-5.0, 5.0, (60, 3))
    shape = (16, 18, 20)
    into = np.column_stack([np.eye(3), np.array(shape) // 2 + 0.5])
    flip = volumes.HALF_TURNS[turned]
    spectra = []
    for cloud in (points, points * flip):
        grids = np.zeros((4, *shape), np.float32)
        volumes._ask(cloud, np.ones(60), np.ones(60), into, grids[:2])
        spectra.append(np.fft.rfftn(grids, axes=(1, 2, 3)).astype(np.complex64))
    answer = np.zeros_like(spectra[0])
    answer[2] = 1.0  # one cell at the origin answers
    product = np.empty(answer.shape[1:], np.complex64)
    volumes._multiply(spectra[0], answer, turned, product)
    expected = np.empty_like(product)
    volumes._multiply(spectra[1], answer, 0, expected)
    np.testing.assert_allclose(product, expected, atol=1e-4)
