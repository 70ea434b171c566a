"""The verdict on labelled cases of every kind: right or wrong, accepted or rejected.

Unlike ``verdict.py``, which asks what acceptance is worth on pairs that mostly have an answer, most cases here have
none, or several: corridors, twin rooms, mirror images, repeats, symmetric objects, streets without overlap.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import metrics, tables
from benchmarks.datasets import apply
from benchmarks.harness import RESULTS
from benchmarks.verdict_cases import Case, cases, real
from csgm_ros import register
from csgm_ros.config import profile, replaced
from csgm_ros.errors import CsgmError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--half', type=int, default=1, choices=(0, 1), help='0: places for fitting, 1: for testing')
    parser.add_argument('--share', type=float, default=1.0, help='of the synthetic cases of each kind')
    parser.add_argument('--kinds', nargs='+', default=None, help='default: all')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--no-real', action='store_true', help='synthetic cases alone')
    parser.add_argument('--results', type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = [_row(case, options.seed) for case in _chosen(options)]
    options.results.mkdir(parents=True, exist_ok=True)
    with (options.results / 'verdict_bed.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    tables.report('verdict_bed', 'The verdict, case by case', summary(rows), options.results)


def _chosen(options) -> Iterator[Case]:
    made = (make() for make in cases(options.share))
    for case in (*made, *(() if options.no_real else real())):
        if case.half == options.half and (options.kinds is None or case.kind in options.kinds):
            yield case


def _row(case: Case, seed: int) -> dict[str, object]:
    config = replaced(profile(), {'threads': 1, 'scale.estimate_scale': not case.rigid})
    start = time.process_time()
    try:
        result = register(
            case.source,
            case.target,
            config,
            seed=seed,
            source_viewpoint=case.eyes[0],
            target_viewpoint=case.eyes[1],
        )
        accepted, reason, confidence = result.accepted, result.reason, result.confidence
        good = right(result.T_target_source, case)
    except CsgmError as error:
        accepted, reason, confidence, good = False, str(error), 0.0, False
    print(f'{case.name}: {"right" if good else "wrong"}, {reason}', file=sys.stderr)
    cpu = round(time.process_time() - start, 2)
    return {
        'case': case.name,
        'kind': case.kind,
        'right': int(good),
        'accepted': int(accepted),
        'confidence': round(confidence, 4),
        'cpu': cpu,
        'reason': reason,
    }


def right(estimate: np.ndarray, case: Case) -> bool:
    """Whether an estimate may be accepted: near the truth where there is one and nothing else fits as well.

    Mean displacement under 5 % of the source's robust radius (3 %, or 10 cm, for real clouds, whose truth is known no
    better), rotation under 5 degrees, scale within 6 %.
    """
    if case.truth is None or not case.determined:
        return False
    moved, there = apply(estimate, case.source), apply(case.truth, case.source)
    size = np.percentile(np.linalg.norm(there - np.median(there, axis=0), axis=1), 90)
    bound = max(0.03 * size, 0.10) if case.real else 0.05 * size
    return bool(
        np.linalg.norm(moved - there, axis=1).mean() < bound
        and metrics.rotation_error_deg(estimate, case.truth) < 5.0
        and metrics.scale_error(estimate, case.truth) < 0.06
    )


def summary(rows: list[dict[str, object]]) -> str:
    """Return the counts by kind, and the 95 % intervals of what matters."""
    kinds: dict[str, list] = defaultdict(list)
    for row in rows:
        kinds[str(row['kind'])].append(row)
    lines = [(kind, *_counts(group)) for kind, group in kinds.items()]
    header = ('kind', 'cases', 'right accepted', 'right rejected', 'wrong accepted', 'wrong rejected', 'CPU s')
    _, kept, missed, false, rejected, _ = _counts(rows)
    return '\n\n'.join(
        [
            tables.table(header, [*lines, ('all', *_counts(rows))]),
            f'- Right ones accepted: {_share(kept, kept + missed)}.\n- Wrong ones accepted: '
            f'{_share(false, false + rejected)}.',
            *(f'- accepted but wrong: {row["case"]} ({row["reason"]})' for row in rows if _false(row)),
        ]
    )


def _counts(rows: list[dict[str, object]]) -> tuple:
    cells = [sum((row['right'], row['accepted']) == cell for row in rows) for cell in ((1, 1), (1, 0), (0, 1), (0, 0))]
    return len(rows), *cells, f'{np.median([row["cpu"] for row in rows]):.1f}'


def _false(row: dict[str, object]) -> bool:
    return bool(row['accepted']) and not row['right']


def _share(hits: int, trials: int) -> str:
    low, high = metrics.wilson(hits, trials)
    return f'{hits} of {trials} ({100 * low:.1f}-{100 * high:.1f} %)'


if __name__ == '__main__':
    main()
