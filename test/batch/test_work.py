"""One pair, from two files to one row and one page."""

import numpy as np
import pytest
from scenes import random_similarity, room

from csgm_ros.batch.pairs import from_table
from csgm_ros.batch.work import register_pair
from csgm_ros.config import profile, replaced
from csgm_ros.types import Similarity

QUICK = replaced(
    profile(),
    {
        'matching.alpha_steps': 5,
        'matching.search_effort': 0.0,
        'supervoxels.seed_size': 0.35,
        'hypotheses.sources': ('graph',),
        'hypotheses.relative_scales': (0.6,),
    },
)


@pytest.fixture(scope='module')
def rows(tmp_path_factory):
    """A pair without a guess and with its page, with a right guess and with one upside down."""
    folder = tmp_path_factory.mktemp('pairs')
    truth = random_similarity(np.random.default_rng(3), (0.3, 0.4), 10.0)
    upside_down = Similarity(truth.scale, truth.rotation @ np.diag([1.0, -1.0, -1.0]), truth.translation)
    np.save(folder / 'a.npy', room(1, 200))
    np.save(folder / 'b.npy', truth.apply(room(2, 200)))
    lines = ['source,target,id,initial']
    for name, guess in (('none', None), ('right', truth), ('wrong', upside_down)):
        numbers = [] if guess is None else guess.matrix.ravel().tolist()
        lines.append(f'a.npy,b.npy,{name},{" ".join(map(repr, numbers))}')
    (folder / 'pairs.csv').write_text('\n'.join([*lines, '']))
    (folder / 'reports').mkdir()
    pairs = from_table(folder / 'pairs.csv', QUICK)
    pages = str(folder / 'reports')
    found = {pair.id: register_pair(pair, 1, pages if pair.id == 'none' else '') for pair in pairs}
    return (
        found,
        {pair.id: folder / 'reports' / f'{pair.key}.html' for pair in pairs},
        truth,
        register_pair(pairs[0], 1),
    )


def test_a_guess_leads_to_it_and_a_wrong_one_to_no_answer(rows):
    found, _, truth, _ = rows
    assert found['right']['accepted'], found['right']['reason']
    matrix = np.reshape(found['right']['T_target_source'], (4, 4))
    np.testing.assert_allclose(matrix, truth.matrix, atol=0.02 * truth.scale)
    assert found['right']['initial'] == truth.matrix.ravel().tolist()
    assert not found['wrong']['accepted']
    assert found['none']['initial'] is None


def test_a_page_is_written_where_one_is_asked_for_and_changes_no_bit(rows):
    found, pages, _, plain = rows
    assert [name for name, page in pages.items() if page.exists()] == ['none']
    assert 'a.npy on b.npy' in pages['none'].read_text()
    for name in ('T_target_source', 'reason', 'margin', 'evidence'):
        assert found['none'][name] == plain[name]
