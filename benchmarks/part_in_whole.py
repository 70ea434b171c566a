"""A small view in a large map: parts of the sources of real pairs, 5 to 20 % of the target's surface on them."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, places, tables
from benchmarks.datasets import Pair, part, place_names

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
    rows = harness.run_all('part_in_whole', cases[: options.pairs or None], options)
    tables.report('part_in_whole', 'A small view in a large map', places.summary(rows), options.results)


def cut(make: Callable[[], Pair], given: bool, seed: int) -> Callable[[], Pair]:
    """Make another part for every seed: the same one whether the scale is given or not."""

    def pair() -> Pair:
        whole = make()
        found = part(whole, np.random.default_rng([seed, *whole.name.encode()]))
        return places.prepared(lambda: dataclasses.replace(found, kind='place'), given, seed)()

    return pair


if __name__ == '__main__':
    main()
