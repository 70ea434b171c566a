"""The report: one page without network that shows right and wrong for what they are, in a real browser."""

import base64
import dataclasses
import gzip
import re
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.browser import chromium, missing, opened, settled
from csgm_ros.config import flatten, profile
from csgm_ros.demo.simulation import simulate
from csgm_ros.io.files import CloudFile
from csgm_ros.types import Hypothesis, Similarity, Term
from csgm_ros.visual.report import would_have_changed, write_report
from csgm_ros.visual.report_data import ReportData, Segmentation
from csgm_ros.visual.scene import scene
from csgm_ros.visual.slices import slices


@pytest.fixture(scope='module')
def made():
    return simulate(0)


def data_of(made, *poses, accepted=True):
    """A report of a simulated pair under given transforms."""
    target = made.target.reshape(-1, 3)[::5].astype(float)
    finite = target[np.isfinite(target).all(axis=1)]
    cells = (finite * 4).astype(int)
    segmentation = Segmentation(finite, cells @ (1, 3, 7) % 40)
    source = Segmentation(made.source, np.zeros(len(made.source), int))
    return ReportData(
        names=('sfm.ply', 'kinect.ply'),
        source=CloudFile(made.source, made.source_colors),
        target=CloudFile(target),
        accepted=accepted,
        reason='as it is <told>',
        poses=tuple(Hypothesis(pose, 0.5 - 0.1 * k, 0.4, 0.3, 1 - 0.2 * k) for k, pose in enumerate(poses)),
        terms=(Term('smaller fitness', 0.3, 0.2, True, 'verification.min_fitness'), Term('margin', 1.1, 1.25)),
        inlier_distance=0.04,
        match_distance=0.2,
        segmentations=(source, segmentation),
        node_affinity=np.eye(30, 40),
        edge_affinity=np.ones((600, 700)),
        assignment=np.eye(30, 40, dtype=np.uint8),
        path=np.column_stack([np.linspace(0, 1, 9), np.arange(9)]),
        timings={'graph matching': 1.0},
        parameters=flatten(profile('paper')),
        defaults=flatten(profile()),
        facts={'seed': '0'},
    )


def turned(truth, degrees=40.0, shift=0.5):
    turn = np.radians(degrees)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    return Similarity(1.0, rotation, np.array([shift, 0, 0])) @ truth


def test_the_page_needs_no_network_and_says_what_it_was_given(made, tmp_path):
    write_report(tmp_path / 'r.html', data_of(made, made.truth))
    page = (tmp_path / 'r.html').read_text()
    for reference in re.findall(r'(?:src|href)="([^"]{0,30})', page):
        assert reference.startswith(('data:', '#'))
    assert not re.search(r'@import|url\(http|fetch\(|XMLHttpRequest', page.split('<body>')[0])
    assert 'as it is &lt;told&gt;' in page
    assert 'MIT License' in page
    assert not re.search('%%[a-z]+%%', page)


def test_two_clouds_of_200_000_points_stay_below_8_mb(made, tmp_path):
    rng, data = np.random.default_rng(0), data_of(made, made.truth, *(turned(made.truth, 10 * k) for k in range(1, 4)))

    def large(points):
        points = points[np.isfinite(points).all(axis=1)]
        more = points[rng.integers(0, len(points), 250_000)] + rng.normal(0, 1e-3, (250_000, 3))
        return CloudFile(more, rng.random((250_000, 3)))

    full = dataclasses.replace(data, source=large(data.source.points), target=large(data.target.points))
    write_report(tmp_path / 'r.html', full)
    assert (tmp_path / 'r.html').stat().st_size < 8e6


def test_points_poses_and_errors_survive_packing(made):
    data = data_of(made, made.truth, turned(made.truth))
    manifest, packed, (source, target) = scene(data)
    raw = np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.uint8)

    def array(name):
        entry = manifest['arrays'][name]
        first, count = entry['offset'], entry['length']
        low = raw[first : first + count]
        return low + 256 * raw[first + count : first + 2 * count].astype(int) if entry['wide'] else low

    cloud = manifest['clouds']['source']
    local = array(cloud['positions']).reshape(-1, 3) * cloud['step'] + cloud['origin']
    view = np.array(manifest['poses'][2]['matrix'])
    seen = target.frame.inverse().apply(local @ view[:3, :3].T + view[:3, 3])
    assert np.allclose(seen, made.truth.apply(source.points), atol=1e-3)
    assert sorted(map(tuple, source.points)) == sorted(map(tuple, made.source))
    right, wrong = (array(manifest['poses'][k]['errors']['source']).mean() for k in (2, 3))
    assert right < 0.5 * wrong
    first = source.points[:256]
    assert np.linalg.norm(first.mean(axis=0) - made.source.mean(axis=0)) < 0.1 * np.ptp(made.source)


def test_a_report_tells_what_would_have_changed_the_verdict(made):
    rejected = would_have_changed(data_of(made, made.truth, accepted=False))
    assert rejected == ['It needs margin at least 1.25; it is 1.1.']
    accepted = would_have_changed(data_of(made, made.truth))
    assert accepted == [
        'It would have been rejected with smaller fitness below 0.2 (verification.min_fitness); it is 0.3.'
    ]


def test_slices_are_darker_where_the_transform_is_right(made):
    target = made.target.reshape(-1, 3).astype(float)
    target = target[np.isfinite(target).all(axis=1)]

    def both(transform):
        pictures = slices(transform.apply(made.source), target)
        return np.mean([(pixels.max(axis=2) < 0.5).sum() / (pixels.min(axis=2) < 0.9).sum() for _, pixels in pictures])

    assert both(made.truth) > 2 * both(turned(made.truth))


@pytest.fixture(scope='module')
def browser():
    pytest.importorskip('selenium.webdriver')
    if missing():
        pytest.skip(f'not installed: {", ".join(missing())}')
    with chromium() as running:
        yield running


def click(browser, selector):
    browser.execute_script('arguments[0].click()', browser.find_element('css selector', selector))
    return settled(browser)


@pytest.fixture(scope='module')
def page(made, tmp_path_factory):
    path = tmp_path_factory.mktemp('page') / 'report.html'
    write_report(path, data_of(made, made.truth, turned(made.truth)))
    return path


def orange(pixels):
    return (pixels[..., 0] > pixels[..., 2] + 60).sum()


def blue(pixels):
    return (pixels[..., 2] > pixels[..., 0] + 60).sum()


def test_layers_colours_and_poses_can_be_chosen_in_a_browser(page, browser):
    start = opened(browser, page)
    assert not [entry for entry in browser.get_log('browser') if entry['level'] == 'SEVERE']
    assert orange(start) > 1000 < blue(start)
    without = click(browser, '[data-layer=source]')
    assert orange(without) == 0
    assert blue(without) >= blue(start)
    assert blue(click(browser, '[data-layer=target]')) == 0
    click(browser, '[data-layer=source]')
    click(browser, '[data-layer=target]')
    before = click(browser, '#flip')
    assert np.abs(before - start).mean() > 1
    assert np.array_equal(click(browser, '#flip'), start)
    assert not np.array_equal(click(browser, '#checker'), start)
    click(browser, '#checker')
    assert len(np.unique(click(browser, '[value=supervoxels]').reshape(-1, 3), axis=0)) > 20
    assert not [entry for entry in browser.get_log('browser') if entry['level'] == 'SEVERE']


def test_a_wrong_pose_looks_wrong(page, browser):
    opened(browser, page)
    click(browser, '[value=error]')
    far = {}
    for pose in (2, 3):
        browser.execute_script(f'csgm.view.set({{pose: {pose}}}, false)')
        pixels = settled(browser)
        drawn = (pixels.min(axis=2) < 250).sum()
        near = (pixels[..., 1] > pixels[..., 0] + 40).sum()  # blue to green
        far[pose] = 1 - near / drawn
    assert far[2] < 0.75 * far[3]


def test_it_turns_smoothly(page, browser):
    opened(browser, page)
    browser.set_script_timeout(60)
    measured = browser.execute_async_script('csgm.bench(30).then(arguments[0])')
    everything = browser.execute_script('return csgm.view.parts.source.count + csgm.view.parts.target.count')
    # on a machine too slow for all of the points fewer are drawn while something moves
    assert measured['fps'] > 20 or 10_000 <= measured['points_moving'] < everything
