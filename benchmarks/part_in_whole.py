"""A small view in a large map: parts of the sources of real pairs, 5 to 20 % of the target's surface on them."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, metrics, places, tables
from benchmarks.datasets import Pair, apply, part, place_names
from csgm_ros.cloud.cells import working_size

SETS = ('places', 'kitchen')
SCALES = 'unknown', 'given'


def main() -> None:
    parser = harness.parser(__doc__, ('csgm', 'fgr+sicp', 'kiss+sicp'))
    parser.add_argument('--scale', nargs='+', choices=SCALES, default=list(SCALES), help='default: %(default)s')
    options = parser.parse_args()
    if not place_names():
        print('skipped: no places; CSGM_SHARED must name the folder that holds data/places')
        return
    makers = [make for name in SETS for make in places.makers(name)]
    cases = [
        harness.Case(f'scale {"given" if given else "unknown"}', cut(make, given, seed), rigid=given)
        for given in places.GIVEN
        if SCALES[given] in options.scale
        for seed in (options.seeds[:1] if options.quick else options.seeds)
        for make in (makers[:2] if options.quick else makers)
    ]
    cases = cases[: options.pairs or None]
    rows = harness.run_all('part_in_whole', cases, options)
    text = f'{ceiling([case.make() for case in cases], rows)}\n\n{places.summary(rows)}'
    tables.report('part_in_whole', 'A small view in a large map', text, options.results)


def cut(make: Callable[[], Pair], given: bool, seed: int) -> Callable[[], Pair]:
    """Make another part for every seed: the same one whether the scale is given or not."""

    def pair() -> Pair:
        whole = make()
        found = part(whole, np.random.default_rng([seed, *whole.name.encode()]))
        return places.prepared(lambda: dataclasses.replace(found, kind='place'), given, seed)()

    return pair


def ceiling(pairs: list[Pair], rows: list[harness.Row]) -> str:
    """Say on how many parts even the truth does not stay right, once it is refined, and what is right on the others."""
    parts = {pair.name: pair for pair in pairs}
    moved = sorted(name for name, pair in parts.items() if not metrics.right(refined_truth(pair), pair))
    others = [row for row in rows if row['pair'] not in moved]
    right = [
        f'{method} {tables.percent(runs, "right_loose")} with {setting}'
        for method, of_method in tables.grouped(others, 'method').items()
        for setting, runs in tables.grouped(of_method, 'setting').items()
    ]
    return (
        f'GICP of Open3D, started at the truth with its scale, ends right on {len(parts) - len(moved)} of '
        f'{len(parts)} parts: a truth is that of a whole, bent cloud, good to some centimetres, and 5 degrees of a '
        f'small part are less. Not on: {", ".join(moved) or "none"}. Of the runs on the others are right: '
        f'{", ".join(right) or "none"}.'
    )


def refined_truth(pair: Pair) -> np.ndarray:
    """Return the true (4, 4) transform after GICP of Open3D at the cells of which the part occupies 4000."""
    from open3d import geometry, pipelines, utility

    placed = apply(pair.T_target_source, pair.source)
    centre, cell = placed.mean(axis=0), working_size(placed, 4000)
    reach = 2 * np.linalg.norm(placed - centre, axis=1).max()
    near = pair.target[np.linalg.norm(pair.target - centre, axis=1) < reach]
    clouds = []
    for points in (placed, near):
        cloud = geometry.PointCloud(utility.Vector3dVector(points - centre)).voxel_down_sample(cell)
        cloud.estimate_normals(geometry.KDTreeSearchParamKNN(20))
        clouds.append(cloud)
    found = pipelines.registration.registration_generalized_icp(*clouds, 3 * cell).transformation
    shift = np.eye(4)
    shift[:3, 3] = centre
    return shift @ found @ np.linalg.inv(shift) @ pair.T_target_source


if __name__ == '__main__':
    main()
