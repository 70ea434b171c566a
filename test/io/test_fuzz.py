"""A seeded part of what `python -m fuzz.fuzz` runs by the ten thousand: damaged inputs are read or refused, no more."""

import pytest
from fuzz import corpus
from fuzz.fuzz import BAGS, run

from csgm_ros.io.files import read_cloud

KINDS = ('ply', 'pcd', 'xyz', 'npy', 'npz', 'las', 'laz', 'e57', 'stl', 'obj', 'glb', 'gltf', 'off')
CLOUDS = (*(f'cloud.{kind}' for kind in KINDS), 'points3D.bin', 'points3D.txt')
FILES = (*CLOUDS, 'depth.png', *corpus.CAMERAS)


def test_every_seed_is_read_as_it_is(tmp_path):
    seeds = corpus.files()
    assert set(seeds) == set(FILES)
    for name in CLOUDS:
        for data in seeds[name]:
            assert corpus.sealed(name, data) == data
            (tmp_path / name).write_bytes(data)
            assert len(read_cloud(tmp_path / name).points) >= 12


@pytest.mark.parametrize('kind', [*FILES, *BAGS, 'yaml'])
def test_damaged_inputs_are_read_or_refused_in_one_line(kind, tmp_path):
    said = run(kind, 40 if kind in BAGS else 100, 1, tmp_path)
    assert said['refused'] > 0
