"""The overview of a batch, read as a browser would."""

from html.parser import HTMLParser

import numpy as np
import pytest
from scenes import room

pytest.importorskip('pyarrow')
from csgm_ros.batch.report import reason_kind, write_report
from csgm_ros.batch.results import Results
from csgm_ros.errors import InputError


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.rows, self.images, self.links, self.text = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == 'tr':
            self.rows.append([])
        elif tag == 'td':
            self.rows[-1].append('')
        elif tag == 'img':
            self.images.append(attributes['src'])
        elif tag == 'a':
            self.links.append(attributes['href'])

    def handle_data(self, data):
        self.text.append(data)
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


@pytest.fixture
def folder(tmp_path):
    np.save(tmp_path / 'a.npy', room(0, density=100))
    clouds = {'source': str(tmp_path / 'a.npy'), 'target': str(tmp_path / 'a.npy')}
    found = {'T_target_source': np.eye(4).ravel().tolist(), 'scale': 1.0, 'margin': 2.5, 'failed': False}
    with Results(tmp_path / 'results') as results:
        results.append({**clouds, **found, 'key': 'k0', 'id': 'good <one>', 'accepted': True, 'reason': '86% fit'})
        results.append({**clouds, **found, 'key': 'k1', 'id': 'other', 'accepted': False, 'reason': 'fits 1.1 times'})
        results.append({**clouds, 'key': 'k2', 'id': 'bad', 'accepted': False, 'failed': True, 'reason': '/x.npy: no'})
    (tmp_path / 'results' / 'reports').mkdir()
    (tmp_path / 'results' / 'reports' / 'k0.html').touch()
    return tmp_path / 'results'


def test_every_pair_has_its_line_its_picture_and_its_page(folder):
    said = write_report(folder, folder / 'report.html')
    assert said.endswith('3 pairs, 2 of them drawn')
    page = Page((folder / 'report.html').read_text())
    assert '3 pairs: 1 accepted, 1 rejected, 1 failed' in page.text
    table = {row[1]: row for row in page.rows if len(row) > 5}
    assert set(table) == {'good <one>', 'other', 'bad'}
    assert (table['good <one>'][2], table['good <one>'][7]) == ('accepted', '2.5')
    assert page.links == ['reports/k0.html']
    from PIL import Image

    for image in page.images:
        pixels = np.asarray(Image.open(folder / image))
        assert pixels.shape == (120, 160, 3)
        assert (pixels < 250).any(2).mean() > 0.02


def test_reasons_are_counted_without_their_numbers_and_names():
    one, other = '86% of the smaller side fits, 2.3 times as well', '9% of the smaller side fits, 12 times as well'
    assert reason_kind({'reason': one}) == reason_kind({'reason': other})
    assert reason_kind({'reason': '/a/b.npy: no such file'}) == reason_kind({'reason': '/c.npy: no such file'})
    assert reason_kind({'reason': one}) != reason_kind({'reason': 'ambiguous'})


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(InputError, match='holds no results; run csgm batch'):
        write_report(tmp_path, tmp_path / 'report.html')
