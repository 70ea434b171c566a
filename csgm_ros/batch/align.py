"""From the results of many pairs to the pose of every cloud in one frame."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np

from csgm_ros.batch import pose_graph
from csgm_ros.batch.pose_graph import Aligned, Edge
from csgm_ros.batch.results import Row, read
from csgm_ros.errors import InputError
from csgm_ros.io.atomic import write_text
from csgm_ros.types import Similarity, rotation_angle

TOLERANCE = 0.1  # of the spread of a cloud: beyond what right registrations are off by


def align(folder: str | Path, output: str | Path, root: str | None = None) -> str:
    """Write the poses of all clouds that accepted pairs connect, as JSON, and return a summary.

    Parameters
    ----------
    folder : str or Path
        Results of a batch.
    output : str or Path
        For each component its `frame` (the cloud whose frame and unit it has) and, by cloud, the 4x4 similarity
        `T_frame_cloud`, ``x_frame = T x_cloud``, with its `scale`; then the pairs left out and why.
    root : str, optional
        Cloud whose frame its component takes, by path or name; default: the one with most pairs.

    Raises
    ------
    InputError
        Where no pair was accepted, the root is not among the clouds, or the output cannot be written.
    """
    rows = [row for row in read(folder) if row['accepted'] and row['source'] != row['target']]
    if not rows:
        raise InputError(f'{folder}: holds no accepted pair; look at csgm batch report {folder}')
    names = sorted({row[side] for row in rows for side in ('source', 'target')})
    numbers = {name: number for number, name in enumerate(names)}
    edges = [_edge(row, numbers) for row in rows]
    aligned = pose_graph.align(len(names), edges, TOLERANCE)
    document = _document(names, rows, edges, aligned, _root(root, names))
    write_text(output, json.dumps(document, indent=2) + '\n')
    return _summary(document, output)


def _edge(row: Row, numbers: dict[str, int]) -> Edge:
    transform = Similarity.from_matrix(np.reshape(row['T_target_source'], (4, 4)))
    center, spread = np.array(row['source_center']), row['source_spread']
    return Edge(numbers[row['source']], numbers[row['target']], transform, center, spread)


def _root(root: str | None, names: list[str]) -> int | None:
    if root is None:
        return None
    found = [
        number for number, name in enumerate(names) if root in (name, Path(name).name) or name.endswith(f'/{root}')
    ]
    if len(found) != 1:
        said = 'is no cloud of an accepted pair' if not found else f'is the name of {len(found)} clouds; give the path'
        raise InputError(f'--root {root}: {said}')
    return found[0]


def _document(names: list[str], rows: list[Row], edges: list[Edge], aligned: Aligned, root: int | None) -> dict:
    degrees = Counter(node for k in np.flatnonzero(aligned.kept) for node in (edges[k].source, edges[k].target))
    components = []
    for number in sorted(set(aligned.component), key=lambda c: (-(aligned.component == c).sum(), c)):
        members = [int(node) for node in np.flatnonzero(aligned.component == number)]
        frame = root if root is not None and root in members else max(members, key=lambda node: (degrees[node], -node))
        to_frame = aligned.poses[frame].inverse()
        clouds = {}
        for node in members:
            pose = Similarity.identity() if node == frame else to_frame @ aligned.poses[node]
            clouds[names[node]] = {'T_frame_cloud': pose.matrix.tolist(), 'scale': pose.scale}
        components.append({'frame': names[frame], 'clouds': clouds})
    return {
        'components': components,
        'inconsistent_pairs': [
            _inconsistency(int(k), names, rows, edges, aligned)
            for k in np.flatnonzero(~aligned.kept & ~aligned.contradicted)
        ],
        'contradicted_pairs': [rows[k]['id'] for k in np.flatnonzero(aligned.contradicted)],
        'unverified_pairs': [rows[k]['id'] for k in np.flatnonzero(aligned.kept & ~aligned.verified)],
        'pairs': [
            {'id': row['id'], 'kept': bool(kept), 'residual': float(residual)}
            for row, kept, residual in zip(rows, aligned.kept, aligned.residuals, strict=True)
        ],
    }


def _inconsistency(k: int, names: list[str], rows: list[Row], edges: list[Edge], aligned: Aligned) -> dict:
    """Say how far a pair is off what the others say, and by which cycle that shows."""
    edge, ends = edges[k], np.array([(e.source, e.target) for e in edges])
    around = pose_graph.path(len(names), ends, aligned.kept | aligned.contradicted, edge.source, edge.target)
    expected = aligned.poses[edge.target].inverse() @ aligned.poses[edge.source]
    off = edge.transform.inverse() @ expected
    return {
        'id': rows[k]['id'],
        'source': names[edge.source],
        'target': names[edge.target],
        'displacement': float(aligned.residuals[k]),
        'rotation_deg': float(np.degrees(rotation_angle(off.rotation))),
        'scale_ratio': off.scale,
        'cycle': [rows[number]['id'] for number in around],
    }


def _summary(document: dict, output: str | Path) -> str:
    sizes = [len(component['clouds']) for component in document['components']]
    lines = [f'{output}: {sum(sizes)} clouds in {len(sizes)} frames ({", ".join(map(str, sizes))} clouds)']
    for pair in document['inconsistent_pairs']:
        lines.append(
            f"inconsistent: {pair['id']} is off by {pair['displacement']:.2f} of its source's spread, "
            f'{pair["rotation_deg"]:.1f} degrees and a factor {pair["scale_ratio"]:.3g} in scale '
            f'from {" + ".join(pair["cycle"])}'
        )
    for name in document['contradicted_pairs']:
        lines.append(f'cut: {name} is the only way between two parts, and an inconsistent pair contradicts it')
    if document['unverified_pairs']:
        lines.append(f'unverified, as in no cycle: {", ".join(document["unverified_pairs"])}')
    return '\n'.join(lines)
