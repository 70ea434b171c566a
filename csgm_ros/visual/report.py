"""One page that shows a registration, needs no network and can be sent to somebody else."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from csgm_ros.io.atomic import write_text
from csgm_ros.io.files import CloudFile
from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT, matrix_text
from csgm_ros.types import Similarity, Term, rotation_angle
from csgm_ros.visual import charts
from csgm_ros.visual.pictures import draw, palette, turned, upright
from csgm_ros.visual.report_data import ReportData
from csgm_ros.visual.scene import COLORS, REACH, SHOWN, Shown, distances, scene
from csgm_ros.visual.slices import slices

DRAWN = 60_000  # points of the pictures; any first part of a shown cloud is an even sample of it


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the page.

    Parameters
    ----------
    path : str or Path
        An .html to write; 1 to 8 MB for clouds of any size, as at most 200,000 points of each are shown.
    data : ReportData

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    manifest, arrays, shown = scene(data)
    parts = {
        'title': f'{data.names[0]} on {data.names[1]}',
        'style': _asset('report.css'),
        'kind': 'accepted' if data.accepted else 'rejected',
        'verdict': escape(f'{"Accepted" if data.accepted else "Rejected"}: {data.reason}'),
        'pair': escape(
            f'source {data.names[0]} ({len(data.source.points):,} points), '
            f'target {data.names[1]} ({len(data.target.points):,} points)'
        ),
        'summary': _summary(data),
        'ramp': f'{REACH * data.inlier_distance:.3g} and more, in the unit of the target',
        'shown': _shown_note(data),
        'sections': '\n'.join(_sections(data, shown)),
        'manifest': json.dumps(manifest, separators=(',', ':')).replace('<', '\\u003c'),
        'arrays': arrays,
        'license': _asset('three/LICENSE'),
        'three': _asset('three/three.min.js').replace('</script', '<\\/script'),
        'viewer': _asset('viewer.js'),
    }
    page = _asset('report.html')
    for name, text in parts.items():  # the last ones are large: what they hold is not looked at again
        page = page.replace(f'%%{name}%%', text, 1)
    write_text(path, page)


def _asset(name: str) -> str:
    return resources.files('csgm_ros.visual').joinpath('assets', *name.split('/')).read_text(encoding='utf-8')


def _shown_note(data: ReportData) -> str:
    largest = max(len(data.source.points), len(data.target.points))
    return f'Of each cloud {SHOWN:,} points are shown at most.' if largest > SHOWN else ''


def _summary(data: ReportData) -> str:
    answer = data.poses[0]
    changed = ''.join(f'<li>{line}</li>' for line in map(escape, would_have_changed(data)))
    return f"""<div><h2>What speaks for it, and what against</h2>{_terms(data.terms)}</div>
<div><h2>What would have changed the verdict</h2><ul>{changed}</ul>
<p class="note">Look at the slices below: where the clouds belong together, blue and orange lie in one dark line.</p>
</div>
<div><h2>Transform</h2><p>scale {answer.transform.scale:.6g}; T_target_source, x_target = s R x_source + t:</p>
<pre>{matrix_text(answer.transform.matrix)}</pre></div>"""


def would_have_changed(data: ReportData) -> list[str]:
    """Return what about the evidence would have to be otherwise for the other verdict, nearest first."""
    lines = []
    for term in sorted(data.terms, key=lambda term: abs(term.value / (term.threshold or 1.0) - 1.0)):
        if term.passed == data.accepted:
            side = 'below' if term.at_least == data.accepted else 'above'
            verb = 'would have been rejected with' if data.accepted else 'needs'
            side = side if data.accepted else ('at least' if term.at_least else 'at most')
            where = f' ({term.parameter})' if term.parameter else ''
            lines.append(f'It {verb} {term.name} {side} {term.threshold:.3g}{where}; it is {term.value:.3g}.')
    return lines or ['No single term decides it: every one of them is on the other side already.']


def _terms(terms: tuple[Term, ...]) -> str:
    rows = []
    for term in terms:
        full = 1.25 * max(abs(term.value), abs(term.threshold), 1e-12) if np.isfinite(term.value) else np.inf
        share = term.value / full if np.isfinite(full) else 1.0
        kind, word = ('ok', 'yes') if term.passed else ('no', 'no')
        bar = _bar(share, kind, term.threshold / full)
        asked = f'{"&ge;" if term.at_least else "&le;"} {term.threshold:.3g}'
        rows.append((escape(term.name), f'{term.value:.3g}', asked, bar, f'<span class="{kind}">{word}</span>'))
    return _table(rows, ('evidence', '', 'asked', '', ''))


def _sections(data: ReportData, shown: tuple[Shown, Shown]):
    yield _slices(data, shown)
    if len(data.poses) > 1:
        yield _hypotheses(data)
    if data.segmentations is not None:
        yield _segmentations(data, shown)
    if data.node_affinity is not None:
        yield _matching(data)
    yield _run(data)


def _section(name: str, title: str, body: str, note: str = '') -> str:
    return f'<section id="{name}"><h2>{title}</h2>{f"<p class=note>{note}</p>" if note else ""}{body}</section>'


def _figure(source: str, caption: str) -> str:
    return f'<figure><img src="{source}" alt="{escape(caption)}"><figcaption>{escape(caption)}</figcaption></figure>'


def _slices(data: ReportData, shown: tuple[Shown, Shown]) -> str:
    source, target = shown
    transform, reach = data.poses[0].transform, REACH * data.inlier_distance
    pictures = slices(transform.apply(source.points[:DRAWN]), target.points[:DRAWN])
    row = ''.join(_figure(charts.png(pixels, 32), title) for title, pixels in pictures)
    back = distances(target, source, transform.inverse(), reach / transform.scale, DRAWN) * transform.scale
    named = {
        'source': (distances(source, target, transform, reach, DRAWN), _hex(SOURCE_TINT)),
        'target': (back, _hex(TARGET_TINT)),
    }
    chart = f'<figure>{charts.histogram(named, reach, data.inlier_distance)}</figure>'
    note = (
        'Source orange, target blue, dark where they are in one place. A wrong transform shows two outlines. The chart '
        'counts every point; the shares of the hypotheses, evenly, only what is turned as the other surface is.'
    )
    return _section('slices', 'Slices, and how far the clouds are apart', f'<div class="row">{row}{chart}</div>', note)


def _hypotheses(data: ReportData) -> str:
    rows = [
        (
            'answer' if rank == 0 else f'competing {rank}',
            f'{pose.ratio:.2f}',
            _bar(pose.ratio / max(pose.ratio for pose in data.poses)),
            f'{pose.fitness_source:.0%} / {pose.fitness_target:.0%}',
            f'{pose.transform.scale:.4g}',
            *_apart(data, pose.transform),
        )
        for rank, pose in enumerate(data.poses)
    ]
    head = ('hypothesis', 'fits', '', 'on the other: source / target', 'scale', 'turned by', 'moved by')
    note = 'The view shows each. The margin is 1 over how well the best competing one fits. Lengths are of the target.'
    return _section('hypotheses', 'Hypotheses', _table(rows, head), note)


def _apart(data: ReportData, transform: Similarity) -> tuple[str, str]:
    """Return how far a transform is from the answer; the distance is the mean of the source's points."""
    answer, points = data.poses[0].transform, data.source.points[:: 1 + len(data.source.points) // 5000]
    moved = np.nanmean(np.linalg.norm(transform.apply(points) - answer.apply(points), axis=1))
    return f'{np.degrees(rotation_angle(answer.rotation.T @ transform.rotation)):.1f} deg', f'{moved:.3g}'


def _segmentations(data: ReportData, shown: tuple[Shown, Shown]) -> str:
    assert data.segmentations is not None
    figures, view = [], turned(upright(shown[1].points), 28, 22)
    for name, cloud, segmentation in zip(('source', 'target'), shown, data.segmentations, strict=True):
        assert cloud.labels is not None
        few = slice(0, DRAWN)
        colors = np.where(
            (cloud.labels[few] < 0)[:, None], 0.8, palette(COLORS)[np.maximum(cloud.labels[few], 0) % COLORS]
        )
        moved = data.poses[0].transform.apply(cloud.points[few]) if name == 'source' else cloud.points[few]
        pixels = draw([CloudFile(moved, colors)], view)
        figures.append(_figure(charts.png(pixels), f'{name}: {segmentation.labels.max(initial=-1) + 1} supervoxels'))
    note = 'Both as seen from the same side under the answer.'
    return _section('supervoxels', 'Supervoxels', f'<div class="row">{"".join(figures)}</div>', note)


def _matching(data: ReportData) -> str:
    assert data.node_affinity is not None
    assert data.edge_affinity is not None
    assert data.assignment is not None
    pictures = [
        _figure(charts.matrix(data.node_affinity), 'K_p: how alike the nodes are (source down, target across)'),
        _figure(charts.matrix(data.edge_affinity), 'K_q: how alike the edges are'),
        _figure(charts.matrix(data.assignment), 'X: the assignment found without knowing the answer'),
    ]
    if data.path is not None:
        chart = charts.curve(data.path, 'alpha, from concave to convex', 'J(X)')
        pictures.append(f'<figure>{chart}<figcaption>J along the path</figcaption></figure>')
    note = ''
    if data.graphs is not None:
        nodes = len(data.graphs[0].nodes)
        note = (
            f'Under the answer {int(data.match_inliers.sum())} of {nodes} nodes of the source have a match that agrees '
            f'with it. Of {len(data.unguided_matches)} matches found without knowing it, '
            f'{int(data.unguided_inliers.sum())} do; few need to.'
        )
    return _section('matching', 'Graph matching', f'<div class="row">{"".join(pictures)}</div>', note)


def _run(data: ReportData) -> str:
    total = sum(data.timings.values()) or 1.0
    timings = _table([(escape(k), f'{v:.2f} s', _bar(v / total)) for k, v in data.timings.items()])
    facts = _table([(escape(k), escape(str(v))) for k, v in data.facts.items()])
    rows = []
    for name, value in data.parameters.items():
        default = data.defaults.get(name, value)
        cells = (escape(name), escape(str(value)), escape(str(default)))
        rows.append(cells if value == default else tuple(f'<b>{cell}</b>' for cell in cells))
    table = _table(rows, ('parameter', 'value', 'default'))
    body = f"""<div class="row"><div><h3>Timings</h3>{timings}</div><div><h3>Run</h3>{facts}</div></div>
<details><summary>Parameters ({len(rows)}; changed ones are bold)</summary>{table}</details>"""
    return _section('run', 'The run', body)


def _table(rows: Sequence[tuple[str, ...]], head: tuple[str, ...] = ()) -> str:
    lines = [''.join(f'<td>{cell}</td>' for cell in row) for row in rows]
    top = [''.join(f'<th>{cell}</th>' for cell in head)] if head else []
    return f'<table>{"".join(f"<tr>{line}</tr>" for line in top + lines)}</table>'


def _bar(share: float, kind: str = '', mark: float | None = None) -> str:
    """Return a bar; ``mark`` is where a threshold stands."""
    line = '' if mark is None else f'<b style="left:{100 * mark:.1f}%"></b>'
    return f'<div class="bar {kind}"><i style="width:{100 * min(1.0, max(0.0, share)):.1f}%"></i>{line}</div>'


def _hex(tint: tuple[float, float, float]) -> str:
    return '#' + ''.join(f'{round(255 * value):02x}' for value in tint)
