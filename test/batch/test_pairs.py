"""Which pairs a batch registers, and what tells two of them apart."""

import json

import numpy as np
import pytest
from scenes import random_similarity

from csgm_ros.batch.pairs import all_pairs, from_folder, from_table
from csgm_ros.config import profile, replaced
from csgm_ros.errors import InputError

UNMOVED = ' '.join(map(str, np.eye(4).ravel()))


def table(folder, text):
    path = folder / 'pairs.csv'
    path.write_text(text)
    return path


def test_a_table_names_files_relative_to_itself(tmp_path):
    path = table(tmp_path, 'source,target,id,seed,parameters\na.ply,sub/b.ply,one,7,icp.iterations=5; threads=1\n')
    (pair,) = from_table(path, profile())
    assert (pair.id, pair.seed, pair.profile) == ('one', 7, 'robust')
    assert (pair.source, pair.target) == (str(tmp_path / 'a.ply'), str(tmp_path / 'sub/b.ply'))
    assert dict(pair.changes) == {'icp.iterations': 5, 'threads': 1}


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('from,to\na,b\n', "unknown column 'from'"),
        ('source,id\na,b\n', 'no columns source and target'),
        ('source,target\na.ply,b.ply\na.ply\n', 'line 3: has not as many values'),
        ('source,target\na.ply,\n', 'line 2: names no target'),
        ('source,target,seed\na.ply,b.ply,-1\n', "seed '-1' is no"),
        ('source,target,parameters\na.ply,b.ply,icp.iteration=1\n', "line 2: no parameter 'icp.iteration'"),
        ('source,target,id\na.ply,b.ply,x\nc.ply,d.ply,x\n', 'pair x is there twice'),
        ('source,target\n', 'holds no pair'),
        ('source,target,initial\na.ply,b.ply,none.json\n', 'none.json: cannot be read'),
        ('source,target,initial\na.ply,b.ply,1 0 0\n', 'is no similarity; give 16 numbers'),
        ('source,target,initial_sigma\na.ply,b.ply,0 1 1\n', 'needs initial'),
        (f'source,target,initial,initial_sigma\na.ply,b.ply,{UNMOVED},0 1\n', 'place, degrees and relative scale'),
        (f'source,target,initial,initial_sigma\na.ply,b.ply,{UNMOVED},0 -1 1\n', 'none may be below 0'),
    ],
)
def test_a_wrong_table_is_refused_with_the_line_and_the_remedy(tmp_path, text, said):
    with pytest.raises(InputError, match=r'pairs\.csv') as caught:
        from_table(table(tmp_path, text), profile())
    assert said in str(caught.value)


def test_only_what_changes_the_result_changes_the_key(tmp_path):
    path = table(tmp_path, 'source,target\na.ply,b.ply\n')
    (first,) = from_table(path, profile())
    changed = [replaced(profile(), {'icp.iterations': 5}), profile('paper')]
    keys = {from_table(path, config)[0].key for config in changed} | {from_table(path, profile(), seed=1)[0].key}
    assert len(keys | {first.key}) == 4
    assert from_table(path, replaced(profile(), {'threads': 3}))[0].key == first.key


def test_where_a_transform_is_expected_comes_as_a_file_or_as_numbers_and_is_of_the_key(tmp_path):
    expected = random_similarity(np.random.default_rng(0))
    (tmp_path / 'guess.json').write_text(json.dumps({'T_target_source': expected.matrix.tolist()}))
    numbers = ' '.join(map(repr, expected.matrix.ravel().tolist()))
    rows = 'a.ply,b.ply,,', 'a.ply,b.ply,guess.json,', f'a.ply,b.ply,{numbers},', 'a.ply,b.ply,guess.json,0.5 20 0.2'
    found = [from_table(table(tmp_path, f'source,target,initial,initial_sigma\n{row}\n'), profile())[0] for row in rows]
    assert found[0].prior is None
    assert found[1] == found[2]
    np.testing.assert_allclose(found[1].prior.transform.matrix, expected.matrix, rtol=1e-12)
    assert (found[1].prior.sigma, found[3].prior.sigma) == ((0.0, 15.0, 0.1), (0.5, 20.0, 0.2))
    assert len({pair.key for pair in found}) == 3


def test_a_folder_pairs_what_lies_together(tmp_path):
    for name in ('x/sfm.ply', 'x/kinect.ply', 'y/sfm.ply', 'y/kinect.ply'):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    pairs = from_folder(tmp_path, '*/sfm.*', '*/kinect.*', profile())
    assert [pair.id for pair in pairs] == ['x', 'y']
    (tmp_path / 'y/sfm.pcd').touch()
    with pytest.raises(InputError, match='narrow the glob'):
        from_folder(tmp_path, '*/sfm.*', '*/kinect.*', profile())
    (tmp_path / 'x/sfm.ply').unlink()
    with pytest.raises(InputError, match=r'no file matches \*/sfm.ply'):
        from_folder(tmp_path, '*/sfm.ply', '*/kinect.ply', profile())


def test_every_two_clouds_of_some_folders_are_paired_once(tmp_path):
    for name in ('a.ply', 'b.npy', 'c.xyz', 'notes.md'):
        (tmp_path / name).touch()
    pairs = all_pairs([tmp_path], '*', profile())
    assert len(pairs) == len({frozenset((pair.source, pair.target)) for pair in pairs}) == 3
    with pytest.raises(InputError, match='holds no pair'):
        all_pairs([tmp_path], '*.ply', profile())
