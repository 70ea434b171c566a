"""Other places and sensors: rooms, desks, shelves, streets, with the scale unknown and given, beside the peers."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import harness, tables
from benchmarks.datasets import (
    Pair,
    frame_numbers,
    frame_pair,
    moved,
    place_names,
    place_pair,
    real_names,
    real_pair,
    shared_unit,
    swapped,
)

METHODS = ('csgm', 'fgr+sicp', 'ransac+sicp', 'ransac-scale+sicp', 'kiss+sicp', 'teaser+sicp')
GIVEN = (False, True)
FRAMES = 5
"""Frames of each sequence against its map."""


def main() -> None:
    parser = harness.parser(__doc__, METHODS)
    parser.add_argument('--sets', nargs='+', default=['places', 'swapped', 'frames', 'kitchen'], help='%(default)s')
    options = parser.parse_args()
    if not place_names():
        print('skipped: no places; CSGM_SHARED must name the folder that holds data/places')
        return
    cases = [
        harness.Case(f'{name}, scale {"given" if given else "unknown"}', prepared(make, given, seed), rigid=given)
        for name in options.sets
        for given in GIVEN
        for seed in (options.seeds[:1] if options.quick else options.seeds)
        for make in (makers(name)[:2] if options.quick else makers(name))
    ]
    rows = harness.run_all('places', cases[: options.pairs or None], options)
    tables.report('places', 'Other places and sensors', summary(rows), options.results)


def makers(name: str) -> list[Callable[[], Pair]]:
    """Return one maker of a pair each for a set: ``places``, ``swapped``, ``frames`` or ``kitchen``."""
    if name == 'kitchen':
        return [lambda pair=pair: real_pair(pair) for pair in real_names()]
    if name == 'frames':
        return [
            lambda sequence=sequence, number=number: frame_pair(sequence, int(number))
            for sequence in ('kitchen', 'desk')
            for number in _spread(frame_numbers(sequence))
        ]
    turn = swapped if name == 'swapped' else lambda pair: pair
    return [lambda pair=pair: turn(place_pair(pair)) for pair in place_names()]


def _spread(numbers: np.ndarray) -> np.ndarray:
    return numbers[np.linspace(0, len(numbers) - 1, FRAMES + 2).astype(int)[1:-1]]


def prepared(make: Callable[[], Pair], given: bool, seed: int) -> Callable[[], Pair]:
    """Seed 0 is the pair as it is; every other seed moves the source first. A given scale is 1."""

    def pair() -> Pair:
        made = shared_unit(make()) if given else make()
        if seed:
            made = moved(made, np.random.default_rng(seed), scale_range=(1.0, 1.0) if given else (0.05, 20.0))
        return dataclasses.replace(made, name=f'{made.name}-{seed}')

    return pair


def summary(rows: list[harness.Row]) -> str:
    """Return one table a setting, and the pairs that the product gets wrong."""
    parts = [
        'Right: mean displacement of the source under 3 % of its robust radius or 10 cm, whichever is more, rotation '
        'under 5 degrees, scale within 6 %. Seed 0 is the pair as it is, every other one a random similarity of it. '
        '`accepted / wrong / missed`: verdicts, wrong ones among them, right answers rejected. Seconds: medians.'
    ]
    for setting, runs in tables.grouped(rows, 'setting').items():
        parts += [f'{setting.capitalize()}:', _table(runs)]
    wrong = [
        f'{row["setting"]}, {row["pair"]}: {float(row["mean"]):.2f}, {float(row["rotation"]):.1f} degrees, scale '
        f'{100 * float(row["scale"]):.0f} %, {"accepted" if int(row["accepted"] or 0) else "rejected"}'
        for row in rows
        if row['method'] == 'csgm' and not int(row['right_loose'])
    ]
    return '\n\n'.join([*parts, 'The product is not right on:', '\n'.join(f'- {line}' for line in wrong) or 'none'])


def _table(rows: list[harness.Row]) -> str:
    header = ('method', 'runs', 'right', 'median displacement', 'rotation, deg', 'scale, %', 'wall s', 'CPU s')
    lines = [
        (
            method,
            len(runs),
            tables.percent(runs, 'right_loose'),
            f'{tables.median(tables.numbers(runs, "mean")):.3f}',
            f'{tables.median(tables.numbers(runs, "rotation")):.1f}',
            f'{100 * tables.median(tables.numbers(runs, "scale")):.1f}',
            f'{tables.median(tables.numbers(runs, "wall")):.2f}',
            f'{tables.median(tables.numbers(runs, "cpu")):.2f}',
            tables.verdict_counts(runs),
        )
        for method, runs in tables.grouped(rows, 'method').items()
    ]
    return tables.table((*header, 'accepted / wrong / missed'), lines)


if __name__ == '__main__':
    main()
