"""Trials of the verdict: a winner, what competes with it, and whether it is right.

Beside what the search finds (*searched*), winners are *planted*: the truth, and slides, turns, other scales and random
poses, each refined as the verdict refines its probes, with the truth withheld, so that the best of the wrong ones has
to be refused. Both are kept and judged again in a second a case when the evidence changes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks import metrics
from benchmarks.datasets import apply
from benchmarks.meshes import random_rotation
from benchmarks.verdict_cases import Case
from csgm_ros import register
from csgm_ros.attempts import Attempt
from csgm_ros.cloud.agreement import Agreement
from csgm_ros.config import Config, VerificationConfig, profile, replaced
from csgm_ros.errors import CsgmError
from csgm_ros.exchange import ordered
from csgm_ros.scale import normalize
from csgm_ros.transform.refinement import refine_between
from csgm_ros.types import Similarity
from csgm_ros.verification.decide import NEARBY, Units, decide
from csgm_ros.verification.evidence import Evidence
from csgm_ros.verification.findings import Findings, Motion, Rival, refined
from csgm_ros.verification.view import View

MOST_SOURCE, MOST_TARGET = 7000, 14000  # points of a trial
PLANTED = ('truth', 'slide', 'turn', 'scale', 'anywhere')
DISTANCES = (4.0, 2.5, 1.5, 0.75, 0.4)  # cells, of the correspondences that planted ones are refined with
RIVALS = 11
ASKED = 2000  # points, in random order, of which the displacement is measured
ELSEWHERE = 2.0  # tolerances within which what was planted has come back to the truth
EVERYTHING = {'verification.different': 0.02}  # that the search has found is kept
LOOSEST = {
    'min_margin': 1.6,
    'min_planes': 0.0,
    'min_coverage': 0.0,
    'max_seen_through': 1.0,
}  # of the curves, one at a time
NOTHING = Evidence(Similarity.identity(), 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Trial:
    """A transform to be judged.

    Attributes
    ----------
    setting : str
        searched, or planted and how.
    winner : (4, 4) ndarray
        Between the clouds' own units.
    others : (N, 4, 4) ndarray
    """

    setting: str
    winner: np.ndarray
    others: np.ndarray


def thinned(case: Case) -> Case:
    """Return a case with few points."""
    return replace(case, source=case.source[:MOST_SOURCE], target=_some(case.target, MOST_TARGET))


def _some(points: np.ndarray, count: int) -> np.ndarray:
    return points[np.random.default_rng(0).permutation(len(points))[:count]]


def config_of(case: Case) -> Config:
    """Return the configuration a case is judged with."""
    return replaced(profile(), {'threads': 1, 'scale.estimate_scale': not case.rigid})


def view_of(case: Case) -> View:
    """Return a case as verification sees it."""
    config = config_of(case)
    pair = ordered(normalize((case.source, case.target), config))
    eyes = case.eyes[::-1] if pair.exchanged else case.eyes
    return View(pair, config, np.random.default_rng(0), refine_between, eyes)


def right(estimate: np.ndarray, case: Case) -> bool:
    """Whether an estimate may be accepted: near the truth where there is one and nothing else fits as well.

    Mean displacement under 5 % of the source's robust radius (3 %, or 10 cm, for real clouds, whose truth is known no
    better: of a depth frame and its map, metres of the frame), rotation under 5 degrees, scale within 6 %.
    """
    return case.determined and case.related and near(estimate, case)


def near(estimate: np.ndarray, case: Case, times: float = 1.0) -> bool:
    """Whether an estimate is where the case has the source, right or not, within some times the tolerance."""
    moved, there = (apply(pose, case.source[:ASKED]) for pose in (estimate, case.pose))
    size = np.percentile(np.linalg.norm(there - np.median(there, axis=0), axis=1), 90)
    bound = max(0.03 * size, 0.10 * case.metre) if case.real else 0.05 * size
    return bool(
        np.linalg.norm(moved - there, axis=1).mean() < times * bound
        and metrics.rotation_error_deg(estimate, case.pose) < times * 5.0
        and metrics.scale_error(estimate, case.pose) < times * 0.06
    )


def searched(case: Case, seed: int = 0, *, exchanged: bool = False) -> dict:
    """Return what the first attempt of the search finds, and what is said of it; no transforms where it finds none."""
    asked = swapped(case) if exchanged else case
    row = {'case': case.name, 'seed': seed, 'exchanged': exchanged, 'found': [], 'accepted': False, 'right': False}
    start = time.process_time()
    try:
        with (
            mock.patch('csgm_ros.registration.schedule', return_value=[Attempt()]),
            mock.patch('csgm_ros.registration.MOST_SHOWN', RIVALS + 1),
        ):
            result = register(
                asked.source,
                asked.target,
                replaced(config_of(case), EVERYTHING),
                seed=seed,
                details=True,
                source_viewpoint=asked.eyes[0],
                target_viewpoint=asked.eyes[1],
            )
    except CsgmError as error:
        return {**row, 'reason': str(error)}
    others = [] if result.details is None else [other.transform.matrix for other in result.details.hypotheses]
    estimate = np.linalg.inv(result.T_target_source) if exchanged else result.T_target_source
    return {
        **row,
        'found': [result.T_target_source.tolist(), *(other.tolist() for other in others)] if others else [],
        'accepted': result.accepted,
        'right': right(estimate, case),
        'near': near(estimate, case),
        'margin': round(result.verdict.margin, 3),
        'reason': result.reason,
        'cpu': round(time.process_time() - start, 2),
    }


def planted(case: Case, view: View) -> list[Trial]:
    """Return winners of known origin: the best of each family that is somewhere else, and the truth."""
    rng = np.random.default_rng([3, *case.name.encode()])
    families = {name: _refined(case, view, changes) for name, changes in _families(case, rng).items() if len(changes)}
    trials = []
    wrong = {name: [m for m in found if not near(m, case, ELSEWHERE)] for name, found in families.items()}
    truth = [m for m in families['truth'] if near(m, case)]
    if truth:
        best = [m for name in ('slide', 'turn', 'anywhere') for m in wrong[name][:4]]
        trials.append(Trial('truth', truth[0], np.array(best).reshape(-1, 4, 4)))
    trials += [
        Trial(name, found[0], np.array(found[1 : 1 + RIVALS]).reshape(-1, 4, 4))
        for name, found in wrong.items()
        if name != 'truth' and found
    ]
    return trials


def _families(case: Case, rng) -> dict[str, np.ndarray]:
    there = apply(case.pose, case.source)
    middle, size = np.median(there, axis=0), metrics.robust_radius(there)
    _, along = np.linalg.eigh(np.cov((there - middle).T))
    slides = [_slide(sign * share * size * axis) for axis in along.T for share in (0.3, 0.7) for sign in (1, -1)]
    turns = [_about(middle, _turn(axis, angle)) for axis in along.T for angle in (60, 90, 180, 270)]
    factors = () if case.rigid else (0.8, 0.88, 1.14, 1.25)
    scales = [_about(middle, factor * np.eye(3)) for factor in factors]
    anywhere = []
    for place in case.target[rng.integers(len(case.target), size=16)]:
        anywhere.append(_slide(place - middle) @ _about(middle, random_rotation(rng)))
    changes = {'truth': [np.eye(4)], 'slide': slides, 'turn': turns, 'scale': scales, 'anywhere': anywhere}
    return {name: np.array(change).reshape(-1, 4, 4) @ case.pose for name, change in changes.items()}


def _slide(offset: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def _about(middle: np.ndarray, linear: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = middle - linear @ middle
    return matrix


def _turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()


def _refined(case: Case, view: View, transforms: np.ndarray) -> np.ndarray:
    """Return (H, 4, 4) transforms between own units refined, best first, all at the scale of the first."""
    comparison, scale = view.comparison(normal(view, transforms[0]).scale)
    source, target = (unit.matrix for unit in view.pair.normalizations)
    shrink = np.diag([scale, scale, scale, 1.0])
    own = np.linalg.inv(transforms) if view.pair.exchanged else transforms
    inner = target @ own @ np.linalg.inv(source) @ np.linalg.inv(shrink)
    moved = refined(comparison, inner, DISTANCES, refine_between, estimate_scale=not case.rigid)
    scores = [comparison.agreement(transform).score for transform in moved]
    found = (np.linalg.inv(target) @ moved @ shrink @ source)[np.argsort(scores)[::-1]]
    return np.linalg.inv(found) if view.pair.exchanged else found


def normal(view: View, transform: np.ndarray) -> Similarity:
    """Return a (4, 4) transform between own units as one between the normalised clouds."""
    source, target = view.pair.normalizations
    own = Similarity.from_matrix(transform)
    return target @ (own.inverse() if view.pair.exchanged else own) @ source.inverse()


def _own(view: View, transform: Similarity) -> np.ndarray:
    """Return a transform between the normalised clouds as one between own units, see :func:`normal`."""
    own = view.pair.in_own_units(transform)
    return (own.inverse() if view.pair.exchanged else own).matrix


# --- the cache: a file of clouds and planted trials for each case


def save(path: Path, case: Case, trials: list[Trial]) -> None:
    """Write a case and its trials."""
    eyes = [np.full(3, np.nan) if eye is None else eye for eye in case.eyes]
    kept = 'name', 'kind', 'half', 'determined', 'rigid', 'real', 'related', 'metre'
    facts = {key: getattr(case, key) for key in kept}
    np.savez(
        path,
        facts=json.dumps(facts),
        source=case.source.astype(np.float32),
        target=case.target.astype(np.float32),
        pose=case.pose,
        eyes=np.array(eyes),
        settings=[trial.setting for trial in trials],
        **{f'trial{k}': np.concatenate([trial.winner[None], trial.others]) for k, trial in enumerate(trials)},
    )


def load(path: Path) -> tuple[Case, list[Trial]]:
    """Read a case and its trials."""
    with np.load(path) as data:
        eyes = tuple(None if np.isnan(eye).any() else eye for eye in data['eyes'])
        case = Case(
            source=data['source'].astype(float),
            target=data['target'].astype(float),
            pose=data['pose'],
            eyes=eyes,
            **json.loads(str(data['facts'])),
        )
        transforms = [(str(setting), data[f'trial{k}']) for k, setting in enumerate(data['settings'])]
    return case, [Trial(setting, found[0], found[1:]) for setting, found in transforms]


def swapped(case: Case) -> Case:
    """Return a case with source and target exchanged."""
    back = np.linalg.inv(case.pose)
    return replace(
        case,
        source=case.target,
        target=case.source,
        pose=back,
        eyes=(case.eyes[1], case.eyes[0]),
        metre=case.metre * metrics.split(back)[0],
    )


def judged(case: Case, trials: Iterable[Trial], view: View) -> list[dict]:
    """Return everything that is found out about the winners of one case.

    Planted winners are polished, as those of the search are already. Probed is what would be accepted otherwise, be one
    of the thresholds as loose as any that is looked at: probes find what speaks against a transform, so that all others
    are rejected with them and without.
    """
    rows = []
    for trial in trials:
        inner = normal(view, trial.winner)
        inner = view.polished(inner) if trial.setting in PLANTED else inner
        others = [normal(view, other) for other in trial.others]
        view.comparison(inner.scale)  # made but once for a pair
        start = time.process_time()
        findings = view.compared(inner, others)
        if _open(findings, case):
            findings = view.probed(inner, findings)
        cpu = time.process_time() - start
        rows.append(
            {
                'case': case.name,
                'kind': case.kind,
                'half': case.half,
                'setting': trial.setting,
                'right': right(_own(view, inner), case),
                'rigid': case.rigid,
                'cpu': round(cpu, 3),
                'findings': _plain(findings),
            }
        )
    return rows


def _open(findings: Findings, case: Case) -> bool:
    limits = [replace(VerificationConfig(), **{name: value}) for name, value in LOOSEST.items()]
    asked = [decide(NOTHING, findings, part, Units(), estimate_scale=not case.rigid) for part in limits]
    return any(verdict.accepted for verdict in asked)


def _plain(findings: Findings) -> dict:
    """Return findings as numbers and lists; of the rivals those that say most."""
    best = sorted(findings.rivals, key=lambda rival: -rival.ratio)
    kept = [rival for rival in best if rival.displacement <= NEARBY] + [r for r in best if r.displacement > NEARBY][:3]
    return asdict(replace(findings, rivals=tuple(replace(rival, transform=None) for rival in kept)))


def ratio_rule(case: Case, trials: Iterable[Trial], view: View) -> list[dict]:
    """Return what version 0.1.0 would have said: shares of points, and their ratio to the best different transform."""
    rows = []
    for trial in trials:
        winner, probe = normal(view, trial.winner), view.surfaces[0].probe
        best = view.measure(winner)
        measured = [view.measure(normal(view, other)) for other in trial.others]
        rivals = [
            other.score
            for other in measured
            if other.score > 1.25 * best.score or winner.displacement(other.transform, probe) > 0.2
        ]
        strongest = max([0.05, *rivals])
        old = best.fitness >= 0.2 and best.score >= 1.25 * strongest and best.score - strongest >= 0.02
        rows.append({'case': case.name, 'setting': trial.setting, 'old': bool(old)})
    return rows


def found(row: dict) -> Findings:
    """Return the findings of a row that was written as JSON."""
    facts = dict(row['findings'])
    facts['agreement'] = Agreement(**facts['agreement'])
    facts['rivals'] = tuple(
        Rival(
            **{
                **rival,
                'motion': rival['motion'] and Motion(**{**rival['motion'], 'axis': np.array(rival['motion']['axis'])}),
            }
        )
        for rival in facts['rivals']
    )
    facts['scale_curve'] = tuple(map(tuple, facts['scale_curve']))
    return Findings(**facts)
