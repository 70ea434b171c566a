"""The verdict: right or wrong, accepted or rejected, on labelled trials of every kind, beside version 0.1.0.

Most trials have no answer, or several: corridors, twin rooms, mirror images, repeats, symmetric objects. Each
case is searched once; what was found is kept outside of the repository, see ``verdict_trials.py``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import metrics, tables
from benchmarks.harness import RESULTS
from benchmarks.verdict_cases import Case, cases, real
from benchmarks.verdict_trials import found, judged, load, planted, save, searched, thinned, view_of
from csgm_ros.config import VerificationConfig
from csgm_ros.types import Similarity
from csgm_ros.verification.decide import Units, decide
from csgm_ros.verification.evidence import Evidence
from csgm_ros.verification.findings import Findings

CACHE = Path(os.environ.get('XDG_CACHE_HOME', Path.home() / '.cache')) / 'csgm_ros' / 'verdict'
HALVES = 'for fitting', 'for testing'
NOTHING = Evidence(Similarity.identity(), 0.0, 0.0, 0.0, 0.0)
CURVES = {
    'min_margin': (1.0, 1.3, 1.6, 1.8, 2.0, 2.2, 2.5, 3.0, 4.0),
    'min_planes': (0.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0),
    'max_scale_ratio': (0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 10.0),
    'max_mirrored': (0.8, 0.9, 1.0, 1.1, 1.2, 100.0),
    'max_half_shift': (0.2, 0.4, 0.5, 0.7, 1.0, 2.0, 100.0),
    'max_seen_through': (0.1, 0.15, 0.2, 0.3, 1.0),
}
BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)  # of the reliability curve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--share', type=float, default=0.17, help='of the cases of each kind (%(default)s)')
    parser.add_argument('--half', type=int, choices=(0, 1), default=None, help='places for fitting, or for testing')
    parser.add_argument('--offline', action='store_true', help='judge what was harvested before, search for no more')
    parser.add_argument('--quick', action='store_true', help='a minute or two: two kinds, to see that it works')
    parser.add_argument('--cache', type=Path, default=CACHE, help='where cases and findings are kept (%(default)s)')
    parser.add_argument('--results', type=Path, default=RESULTS)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    if not options.offline:
        for case in _chosen(options):
            harvest(case, options.cache)
    rows = findings_of(options.cache, options.half)
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / 'verdict.json').write_text(json.dumps(numbers(rows), indent=1) + '\n')
    tables.report('verdict', 'The verdict', summary(rows), options.results)


def _chosen(options) -> Iterator[Case]:
    makers = cases(options.share, options.half)
    if options.quick:
        for _, make in zip(range(2), makers, strict=False):
            yield make()
        return
    for make in makers:
        yield make()
    yield from (case for case in real(options.half) if options.half in (None, case.half))


def harvest(case: Case, cache: Path) -> None:
    """Search, plant and judge one case, unless that was done before."""
    path = cache / f'{case.name.replace("/", "_").replace("|", "_")}.npz'
    if path.exists():
        return
    case = thinned(case)
    view, first = view_of(case), searched(case) if _is_searched(case) else None
    trials = ([first] if first else []) + planted(case, view)
    _keep(judged(case, trials, view), cache)
    save(path, case, trials)
    print(f'harvested {case.name}', file=sys.stderr, flush=True)


def _is_searched(case: Case) -> bool:
    """Searching costs most: the first two places of each kind, and a third of the unrelated clouds."""
    number = case.name.rpartition('-')[2]
    if case.kind in ('unrelated', 'frame in map'):
        return case.name.encode()[-1] % 3 == 0
    return not number.isdigit() or int(number) < 2


def findings_of(cache: Path, half: int | None = None) -> list[dict]:
    """Return what is found out about every trial in the cache; kept for as long as the code does not change."""
    done = {row['case'] for row in _kept(cache)}
    for path in sorted(cache.glob('*.npz')):
        case, trials = load(path)
        if case.name not in done and half in (None, case.half):
            _keep(judged(case, trials, view_of(case)), cache)
            print(f'judged {case.name}', file=sys.stderr, flush=True)
    return [row for row in _kept(cache) if half in (None, row['half'])]


def _kept(cache: Path) -> list[dict]:
    path = cache / f'findings-{_state()}.jsonl'
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _keep(rows: list[dict], cache: Path) -> None:
    text = ''.join(json.dumps(row, default=np.ndarray.tolist) + '\n' for row in rows)
    with (cache / f'findings-{_state()}.jsonl').open('a') as file:
        file.write(text)


def _state() -> str:
    """Return a digest of the code that finds out."""
    package = Path(__file__).resolve().parents[1] / 'csgm_ros'
    files = [path for path in sorted((package / 'verification').glob('*.py')) if path.name != 'decide.py']
    files += [package / 'cloud' / 'agreement.py', package / 'cloud' / 'witnesses.py']
    files += [package / 'transform' / 'batch_icp.py', Path(__file__).with_name('verdict_trials.py')]
    return hashlib.sha256(b''.join(path.read_bytes() for path in files)).hexdigest()[:12]


# --- counting


def verdict_on(row: dict, findings: Findings, limits: VerificationConfig):
    """Return the verdict on one trial."""
    return decide(NOTHING, findings, limits, Units(), estimate_scale=not row['rigid'])


def decided(rows: list[dict], limits: VerificationConfig | None = None) -> list[dict]:
    """Return the rows with verdicts."""
    limits, out = limits or VerificationConfig(), []
    for row in rows:
        verdict = verdict_on(row, found(row), limits)
        out.append({**row, 'accepted': verdict.accepted, 'confidence': verdict.confidence, 'reason': verdict.reason})
    return out


def counts(rows: list[dict], key: str = 'accepted') -> tuple[int, int, int, int]:
    """Return right and accepted, right and rejected, wrong and accepted, wrong and rejected."""
    cells = (True, True), (True, False), (False, True), (False, False)
    right, rejected, false, refused = (sum((row['right'], row[key]) == cell for row in rows) for cell in cells)
    return right, rejected, false, refused


def numbers(rows: list[dict]) -> dict:
    """Return every figure of the summary by name."""
    judged_rows = decided(rows)
    halves = {}
    for half, name in enumerate(HALVES):
        own = [row for row in judged_rows if row['half'] == half]
        kinds = tables.grouped(own, 'kind')
        halves[name] = {
            'cases': len({row['case'] for row in own}),
            'trials': len(own),
            'now': counts(own),
            '0.1.0': counts(own, 'old'),
            'wrong accepted 95 %': metrics.wilson(counts(own)[2], sum(counts(own)[2:])),
            'by setting': {k: counts(v) for k, v in tables.grouped(own, 'setting').items()},
            'by kind': {k: {'now': counts(v), '0.1.0': counts(v, 'old')} for k, v in kinds.items()},
            'reliability': reliability(own),
            'CPU s of findings, median and 95 %': [
                float(np.percentile([row['cpu'] for row in own if row['right']] or [0.0], q)) for q in (50, 95)
            ],
        }
    return halves


def reliability(rows: list[dict]) -> list[tuple[float, float, int, int]]:
    """Return, for each bin of the confidence: its lower edge, the mean confidence, the right ones, and all."""
    place = np.clip(np.digitize([row['confidence'] for row in rows], BINS) - 1, 0, len(BINS) - 2)
    out = []
    for k in range(len(BINS) - 1):
        own = [row for row, where in zip(rows, place, strict=True) if where == k]
        if own:
            mean = float(np.mean([row['confidence'] for row in own]))
            out.append((BINS[k], round(mean, 4), sum(row['right'] for row in own), len(own)))
    return out


# --- words


def summary(rows: list[dict]) -> str:
    """Return the tables."""
    rows = decided(rows)
    parts = [
        'A trial is a transform to be judged: what one attempt of the search found (searched), or the truth, slides, '
        'turns, other scales and random poses of it, refined, with the truth withheld (planted). Wrong is all that may '
        'not be accepted: also the true pose where another fits as well. 95 % intervals in brackets. 0.1.0: its ratio '
        'of shares, on the same trials.'
    ]
    for half, name in reversed(list(enumerate(HALVES))):
        own = [row for row in rows if row['half'] == half]
        if own:
            parts += [f'Places {name}:', *_half(own)]
    own = [row for row in rows if row['half'] == 1] or rows
    parts += [
        'Reliability of the confidence on the places for testing:',
        tables.table(
            ('confidence from', 'mean', 'right', 'of', 'share right'),
            [(low, mean, right, of, _share(right, of)) for low, mean, right, of in reliability(own)],
        ),
        'Each threshold moved alone, all places: right accepted / wrong accepted.',
        tables.table(('threshold', 'value: right / wrong'), curves(rows)),
        *(f'- accepted but wrong: {_of(row)}' for row in rows if row['accepted'] and not row['right']),
        *(f'- right but rejected: {_of(row)}' for row in rows if row['right'] and not row['accepted']),
    ]
    return '\n\n'.join(parts)


def _of(row: dict) -> str:
    return f'{row["case"]}, {row["setting"]} ({row["reason"]})'


def _half(rows: list[dict]) -> list[str]:
    header = ('', 'cases', 'right: accepted, rejected', 'wrong: accepted, rejected', '0.1.0: right', '0.1.0: wrong')
    groups = [*tables.grouped(rows, 'setting').items(), *tables.grouped(rows, 'kind').items(), ('all', rows)]
    kept, missed, false, refused = counts(rows)
    hit = {row['case'] for row in rows if row['accepted'] and not row['right']}
    places = {row['case'] for row in rows if not row['right']}
    searched_right = [row for row in rows if row['right'] and row['setting'] == 'searched']
    seen = sum(row['accepted'] for row in searched_right)
    return [
        tables.table(header, [_line(name, group) for name, group in groups]),
        f'- Right ones accepted: {_share(kept, kept + missed)}; of those that the search found: '
        f'{_share(seen, len(searched_right))}.\n'
        f'- Wrong ones accepted: {_share(false, false + refused)} of the trials, {_share(len(hit), len(places))} of '
        'the cases.',
    ]


def _line(name: str, rows: list[dict]) -> tuple:
    new, old = counts(rows), counts(rows, 'old')
    cells = [f'{a} / {b}' for a, b in ((new[0], new[1]), (new[2], new[3]), (old[0], old[1]), (old[2], old[3]))]
    return name, len({row['case'] for row in rows}), *cells


def curves(rows: list[dict]) -> list[tuple[str, str]]:
    """Return what each threshold does to the counts."""
    lines = []
    known = [(row, found(row)) for row in rows]
    for name, values in CURVES.items():
        cells = []
        for value in values:
            limits = replace(VerificationConfig(), **{name: value})
            hits = [row['right'] for row, findings in known if verdict_on(row, findings, limits).accepted]
            cells.append(f'{value:g}: {sum(hits)} / {len(hits) - sum(hits)}')
        lines.append((name, ', '.join(cells)))
    return lines


def _share(hits: int, trials: int) -> str:
    low, high = metrics.wilson(hits, trials)
    return f'{hits} of {trials} ({100 * low:.1f}-{100 * high:.1f} %)'


if __name__ == '__main__':
    main()
