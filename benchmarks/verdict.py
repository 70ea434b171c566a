"""The verdict: right or wrong, accepted or rejected, on labelled trials of every kind, beside version 0.1.0.

Most trials have no answer, or several: corridors, twin rooms, mirror images, repeats, symmetric objects. Cases, planted
trials and what the search has found are kept outside of the repository, so that a run goes on where the last one ended
(`--minutes` ends it), a larger share adds to what is there, and a change of the evidence costs no new search.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import metrics, tables
from benchmarks.harness import RESULTS
from benchmarks.verdict_cases import Case, cases, real
from benchmarks.verdict_trials import (
    LOOSEST,
    NOTHING,
    Trial,
    found,
    judged,
    load,
    planted,
    ratio_rule,
    save,
    searched,
    swapped,
    thinned,
    view_of,
)
from csgm_ros.config import VerificationConfig
from csgm_ros.registration import warm_up
from csgm_ros.verification.decide import Units, decide
from csgm_ros.verification.findings import Findings

CACHE = Path(os.environ.get('XDG_CACHE_HOME', Path.home() / '.cache')) / 'csgm_ros' / 'verdict'
HALVES = 'for fitting', 'for testing'
SEARCHED, EARLIER = 'searched.jsonl', 'version-0.1.0.jsonl'
FOUND = 'searched'
CURVES = {
    'min_margin': (LOOSEST['min_margin'], 1.9, 2.2, 2.4, 2.6, 3.0, 4.0),
    'min_significance': (3.0, 3.5, 4.0, 5.0),
    'min_planes': (0.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0),
    'min_coverage': (0.0, 0.03, 0.05, 0.07, 0.1, 0.15),
    'max_scale_ratio': (0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 10.0),
    'max_mirrored': (0.8, 0.9, 1.0, 1.1, 1.25, 100.0),
    'max_half_shift': (0.2, 0.4, 0.5, 0.7, 1.0, 2.0, 100.0),
    'max_seen_through': (0.1, 0.15, 0.2, 0.3, 1.0),
}
BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)  # of the reliability curve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--share', type=float, default=1.0, help='of the cases of each kind (%(default)s)')
    parser.add_argument('--searched', type=int, default=1, help='of each kind are searched too (%(default)s)')
    parser.add_argument('--seeds', type=int, default=1, help='that the steady ones are searched with (%(default)s)')
    parser.add_argument('--swap', action='store_true', help='search the steady ones from target to source too')
    parser.add_argument('--steady', type=int, default=1, help='of each kind are asked to be steady (%(default)s)')
    parser.add_argument(
        '--minutes', type=float, default=float('inf'), help='CPU time, after which the rest is left out'
    )
    parser.add_argument('--half', type=int, choices=(0, 1), default=None, help='places for fitting, or for testing')
    parser.add_argument('--offline', action='store_true', help='judge what was harvested before, search for no more')
    parser.add_argument('--quick', action='store_true', help='a minute: two cases, to see that it works')
    parser.add_argument('--cache', type=Path, default=CACHE, help='where cases and findings are kept (%(default)s)')
    parser.add_argument('--results', type=Path, default=RESULTS)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    if not options.offline:
        warm_up()
        harvest(options)
    rows = decided(findings_of(options.cache, options.half))
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / 'verdict.json').write_text(json.dumps(numbers(rows), indent=1) + '\n')
    tables.report('verdict', 'The verdict', summary(rows), options.results)


def harvest(options) -> None:
    """Make and plant cases and search the first of each kind, while there is time; go on where it was left."""
    done = {(row['case'], row['seed'], row['exchanged']) for row in _read(options.cache / SEARCHED)}
    names = []
    for name, make in _until(_chosen(options), options.minutes):
        _plant(name, make, options.cache)
        names.append(name)
        if _is_among(name, options.searched) and (name, 0, False) not in done:
            _search(name, 0, False, options.cache)
    steady = [name for name in names if _is_among(name, options.steady)]
    again = [(seed, False) for seed in range(1, options.seeds)] + [(0, True)] * options.swap
    jobs = [(name, *run) for name in steady for run in again]
    for job in _until((job for job in jobs if job not in done), options.minutes):
        _search(*job, options.cache)


def _search(name: str, seed: int, exchanged: bool, cache: Path) -> None:
    row = searched(load(_path(name, cache))[0], seed, exchanged=exchanged)
    _keep([row], cache / SEARCHED)
    print(f'searched {name}, seed {seed}{", exchanged" * exchanged}: {row["cpu"]} s', file=sys.stderr, flush=True)


def _chosen(options) -> Iterator[tuple[str, Callable[[], Case]]]:
    made = cases(options.share, options.half)
    if options.quick:
        return itertools.islice(made, 2)
    own = (case for case in real(options.half) if options.half in (None, case.half))
    return _mixed(made, ((case.name, lambda case=case: case) for case in own))


def _mixed(many: Iterator, few: Iterator, every: int = 6) -> Iterator:
    for item in many:
        yield from itertools.chain(itertools.islice(few, 1), [item], itertools.islice(many, every - 1))
    yield from few


def _until(items: Iterable, minutes: float) -> Iterator:
    for item in items:
        if time.process_time() > 60.0 * minutes:
            print('out of time; the rest is left for another run', file=sys.stderr)
            return
        yield item


def _is_among(name: str, most: int) -> bool:
    """Whether a case is among the first of its kind in its half; of the few real ones, all but the unrelated are."""
    number = name.rpartition('-')[2]
    if '|' in name:
        return sum(name.encode()) % 12 < most
    return not number.isdigit() or int(number) // 2 < most


def _path(name: str, cache: Path) -> Path:
    return cache / f'{name.replace("/", "_").replace("|", "_")}.npz'


def _plant(name: str, make: Callable[[], Case], cache: Path) -> None:
    """Make, plant and judge one case, unless that was done before."""
    path = _path(name, cache)
    if not path.exists():
        case = thinned(make())
        view = view_of(case)
        trials = planted(case, view)
        _keep(judged(case, trials, view), _findings(cache))
        save(path, case, trials)
        print(f'planted {name}', file=sys.stderr, flush=True)


def findings_of(cache: Path, half: int | None = None) -> list[dict]:
    """Return what is found out about every trial in the cache; kept for as long as the code does not change."""
    done = {(row['case'], row['setting']) for row in _read(_findings(cache))}
    earlier = {(row['case'], row['setting']): row['old'] for row in _read(cache / EARLIER)}
    runs = tables.grouped((row for row in _read(cache / SEARCHED) if row['found']), 'case')
    for path in sorted(cache.glob('*.npz')):
        case, trials = load(path)
        forth = [_trial(run) for run in runs.get(case.name, ()) if not run['exchanged']]
        back = [_trial(run) for run in runs.get(case.name, ()) if run['exchanged']]
        for own, all_ in ((case, [*trials, *forth]), (swapped(case), back)):
            missing = [trial for trial in all_ if (case.name, trial.setting) not in done]
            if missing and half in (None, case.half):
                view = view_of(own)
                _keep(judged(own, missing, view), _findings(cache))
                new = [t for t in missing if t.setting == FOUND and (case.name, t.setting) not in earlier]
                _keep(ratio_rule(case, new, view), cache / EARLIER)
                print(f'judged {case.name}', file=sys.stderr, flush=True)
    earlier = {(row['case'], row['setting']): row['old'] for row in _read(cache / EARLIER)}
    rows = [row for row in _read(_findings(cache)) if half in (None, row['half'])]
    return [{**row, 'old': earlier.get((row['case'], row['setting']))} for row in rows]


def _trial(run: dict) -> Trial:
    """Return what was found by one run of the search, as a trial."""
    how = f', seed {run["seed"]}' * (run['seed'] > 0) + ', exchanged' * run['exchanged']
    return Trial(FOUND + how, np.array(run['found'][0]), np.array(run['found'][1:]).reshape(-1, 4, 4))


def _findings(cache: Path) -> Path:
    return cache / f'findings-{_state()}.jsonl'


def _read(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _keep(rows: list[dict], path: Path) -> None:
    text = ''.join(json.dumps(row, default=np.ndarray.tolist) + '\n' for row in rows)
    with path.open('a') as file:
        file.write(text)


@cache
def _state() -> str:
    """Return a digest of the code that finds out."""
    package = Path(__file__).resolve().parents[1] / 'csgm_ros'
    files = [path for path in sorted((package / 'verification').glob('*.py')) if path.name != 'decide.py']
    others = 'exchange.py', 'cloud/agreement.py', 'cloud/witnesses.py', 'transform/batch_icp.py'
    files += [*map(package.joinpath, others), Path(__file__).with_name('verdict_trials.py')]
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
    """Return every figure of the summary by name; ``rows`` with verdicts."""
    halves = {}
    for half, name in enumerate(HALVES):
        own = [row for row in _once(rows) if row['half'] == half]
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
            'CPU s of findings, median and 95 %': _cpu(own),
        }
    return {**halves, 'steady': steadiness(rows)}


def _once(rows: list[dict]) -> list[dict]:
    """Return the trials but for those of further seeds and of exchanged clouds."""
    return [row for row in rows if not row['setting'].startswith(f'{FOUND},')]


def _cpu(rows: list[dict]) -> list[float]:
    return [float(np.percentile([row['cpu'] for row in rows if row['accepted']] or [0.0], q)) for q in (50, 95)]


def steadiness(rows: list[dict]) -> dict:
    """Return how many of the cases that were searched several times got the same verdict every time, and which not."""
    found = tables.grouped((row for row in rows if row['setting'].startswith(FOUND)), 'case')
    several = {case: runs for case, runs in found.items() if len(runs) > 1}
    placed = {case: runs for case, runs in several.items() if all(run['right'] for run in runs)}
    differ = {
        case: [f'{run["setting"]}: {"accepted" if run["accepted"] else run["reason"]}' for run in runs]
        for case, runs in several.items()
        if len({run['accepted'] for run in runs}) > 1
    }
    return {
        'cases': len(several),
        'runs': sum(map(len, several.values())),
        'same': len(several) - len(differ),
        'cases, right every time': len(placed),
        'same, right every time': len(placed.keys() - differ.keys()),
        'different': differ,
    }


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
    """Return the tables; ``rows`` with verdicts."""
    steady, rows = steadiness(rows), _once(rows)
    cost = _cpu(rows)
    parts = [
        'A trial is a transform to be judged: what one attempt of the search found (searched), or the truth, slides, '
        'turns, other scales and random poses of it, refined, with the truth withheld (planted). Wrong is all that may '
        'not be accepted: also the true pose where another fits as well. 95 % intervals in brackets. 0.1.0: its ratio '
        'of shares, on what the search found.'
    ]
    for half, name in reversed(list(enumerate(HALVES))):
        own = [row for row in rows if row['half'] == half]
        if own:
            parts += [f'Places {name}:', *_half(own)]
    own = [row for row in rows if row['half'] == 1] or rows
    parts += [
        f'CPU seconds of all that is found out about an accepted one: median {cost[0]:.2f}, 95 % {cost[1]:.2f}.',
        _steady(steady),
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


def _steady(steady: dict) -> str:
    if not steady['cases']:
        return 'None was searched with several seeds, or from target to source.'
    placed = steady['cases, right every time']
    return '\n'.join(
        [
            'Same verdict with every seed and with the clouds exchanged: '
            f'{_share(steady["same"], steady["cases"])} cases, searched {steady["runs"]} times; '
            f'of those in which every search was right: {_share(steady["same, right every time"], placed)}.',
            *(f'- {case}: {"; ".join(said)}' for case, said in steady['different'].items()),
        ]
    )


def _of(row: dict) -> str:
    return f'{row["case"]}, {row["setting"]} ({row["reason"]})'


def _half(rows: list[dict]) -> list[str]:
    header = ('', 'cases', 'right: accepted, rejected', 'wrong: accepted, rejected', '0.1.0: right', '0.1.0: wrong')
    groups = [*tables.grouped(rows, 'setting').items(), *tables.grouped(rows, 'kind').items(), ('all', rows)]
    kept, missed, false, refused = counts(rows)
    hit = {row['case'] for row in rows if row['accepted'] and not row['right']}
    places = {row['case'] for row in rows if not row['right']}
    searched_right = [row for row in rows if row['right'] and row['setting'] == FOUND]
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
    if not trials:
        return 'none of none'
    low, high = metrics.wilson(hits, trials)
    return f'{hits} of {trials} ({100 * low:.1f}-{100 * high:.1f} %)'


if __name__ == '__main__':
    main()
