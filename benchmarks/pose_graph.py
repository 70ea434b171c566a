"""One frame for overlapping parts of real clouds, with a tenth of wrong pairs planted: errors against known truth.

Every part is a slab of one Kinect cloud, in a unit and pose of its own; parts next to each other are registered, and
accepted pairs become a pose graph. ``python benchmarks/pose_graph.py --clouds kitchen_000_120``
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from csgm_ros.batch.align import align
from csgm_ros.batch.pairs import from_table
from csgm_ros.batch.results import Results
from csgm_ros.batch.work import register_pair
from csgm_ros.config import profile
from csgm_ros.io.files import read_cloud
from csgm_ros.types import Similarity


def random_similarity(rng: np.random.Generator, length: float) -> Similarity:
    from scipy.spatial.transform import Rotation

    scale = float(np.exp(rng.uniform(-1.5, 1.5)))
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(scale=length, size=3))


def slabs(points: np.ndarray, count: int, width: float) -> list[np.ndarray]:
    """Cut a cloud along its longest axis into overlapping slabs, each ``width`` of the points."""
    centred = points - points.mean(0)
    order = np.argsort(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 2])
    size = round(width * len(points))
    starts = np.linspace(0, len(points) - size, count).astype(int)
    return [points[np.sort(order[start : start + size])] for start in starts]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--clouds', nargs='+', default=['kitchen_000_120'])
    parser.add_argument('--parts', type=int, default=10)
    parser.add_argument('--width', type=float, default=0.6, help='share of the points in a part')
    parser.add_argument('--reach', type=int, default=3, help='parts registered with each')
    parser.add_argument('--quick', action='store_true', help='five parts')
    options = parser.parse_args()
    count = 5 if options.quick else options.parts
    for name in options.clouds:
        file = Path(os.environ['CSGM_SHARED']) / 'data/kinect_sfm' / name / 'kinect.ply'
        with tempfile.TemporaryDirectory() as folder:
            report(name, slabs(read_cloud(file).points, count, options.width), options.reach, Path(folder))


def solved(parts: list[np.ndarray], reach: int, folder: Path) -> tuple[list[dict], set[str], str, dict]:
    """Register parts with those before them, plant wrong pairs and align.

    Returns
    -------
    rows : list of dict
        Of the batch, the planted ones included.
    planted : set of str
        Pairs that were made wrong.
    said : str
        Summary of the alignment.
    errors : dict of int to (float, float)
        By part: mean displacement of its points in the unit of the parts, and factor on its scale.
    """
    rng = np.random.default_rng(0)
    lines, truth = ['source,target,id'], []
    for number, points in enumerate(parts):
        truth.append(random_similarity(rng, 5.0))  # common frame to that of the part
        np.save(folder / f'{number}.npy', truth[-1].apply(points))
        lines += [f'{number}.npy,{k}.npy,{number}-{k}' for k in range(max(0, number - reach), number)]
    (folder / 'pairs.csv').write_text('\n'.join([*lines, '']))
    rows = [register_pair(pair, 1) for pair in from_table(folder / 'pairs.csv', profile())]
    accepted = [row for row in rows if row['accepted']]
    planted = set()
    for number in rng.permutation(len(accepted))[: round(0.1 * len(accepted))]:
        row = accepted[number]
        planted.add(row['id'])
        wrong = random_similarity(rng, row['source_spread'])
        row['T_target_source'] = (np.reshape(row['T_target_source'], (4, 4)) @ wrong.matrix).ravel().tolist()
    with Results(folder / 'results') as results:
        for row in rows:
            results.append(row)
    said = align(folder / 'results', folder / 'poses.json')
    errors = {}
    for component in json.loads((folder / 'poses.json').read_text())['components']:
        frame = int(Path(component['frame']).stem)
        for path, cloud in component['clouds'].items():
            node = int(Path(path).stem)
            found = Similarity.from_matrix(np.array(cloud['T_frame_cloud']))
            right = truth[frame] @ truth[node].inverse()
            points = truth[node].apply(parts[node])
            off = np.linalg.norm(found.apply(points) - right.apply(points), axis=1).mean() / truth[frame].scale
            errors[node] = float(off), found.scale / right.scale
    return rows, planted, said, errors


def inconsistent(folder: Path) -> set[str]:
    """Return the pairs that an alignment left out."""
    return {pair['id'] for pair in json.loads((folder / 'poses.json').read_text())['inconsistent_pairs']}


def report(name: str, parts: list[np.ndarray], reach: int, folder: Path) -> None:
    """Register, plant, align and print."""
    rows, planted, said, errors = solved(parts, reach, folder)
    accepted = sum(row['accepted'] for row in rows)
    print(f'{name}: {len(rows)} pairs, {accepted} accepted, wrong planted: {", ".join(sorted(planted))}\n{said}')
    named = inconsistent(folder)
    print(f'planted and named: {len(planted & named)} of {len(planted)}; right ones named: {len(named - planted)}')
    for node, (off, factor) in sorted(errors.items()):
        print(f'  part {node}: {100 * off:6.2f} cm off, scale {100 * (factor - 1):+.2f} %')


if __name__ == '__main__':
    main()
