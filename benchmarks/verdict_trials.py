"""Trials of the verdict: a winner, what competes with it, and whether it is right; harvested once, judged in seconds.

The search is what costs. So each case is searched once and its candidates are kept, and beside what the search found
(*searched*), winners are *planted*: the truth, and slides, turns, other scales and random poses, each refined as the
verdict refines its probes, with the truth withheld, so that the best of the wrong ones has to be refused.
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
from csgm_ros.config import Config, profile, replaced
from csgm_ros.errors import CsgmError
from csgm_ros.scale import normalize
from csgm_ros.transform.refinement import refine_between
from csgm_ros.types import Similarity
from csgm_ros.verification.findings import Findings, Motion, Rival, refined
from csgm_ros.verification.view import View

MOST_SOURCE, MOST_TARGET = 7000, 14000  # points of a trial
PLANTED = ('truth', 'slide', 'turn', 'scale', 'anywhere')
DISTANCES = (4.0, 2.5, 1.5, 0.75, 0.4)  # cells, of the correspondences that planted ones are refined with
RIVALS = 11
EVERYTHING = {'verification.different': 0.02}  # that the search has found is kept


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
    pair = normalize((case.source, case.target), config)
    return View(pair, config, np.random.default_rng(0), refine_between, case.eyes)


def right(estimate: np.ndarray, case: Case) -> bool:
    """Whether an estimate may be accepted: near the truth where there is one and nothing else fits as well.

    Mean displacement under 5 % of the source's robust radius (3 %, or 10 cm, for real clouds, whose truth is known no
    better), rotation under 5 degrees, scale within 6 %.
    """
    return case.determined and case.related and near(estimate, case)


def near(estimate: np.ndarray, case: Case) -> bool:
    """Whether an estimate is where the case has the source, right or not."""
    moved, there = apply(estimate, case.source), apply(case.pose, case.source)
    size = np.percentile(np.linalg.norm(there - np.median(there, axis=0), axis=1), 90)
    bound = max(0.03 * size, 0.10) if case.real else 0.05 * size
    return bool(
        np.linalg.norm(moved - there, axis=1).mean() < bound
        and metrics.rotation_error_deg(estimate, case.pose) < 5.0
        and metrics.scale_error(estimate, case.pose) < 0.06
    )


def searched(case: Case, seed: int = 0) -> Trial | None:
    """Return what the first attempt of the search finds; None where it finds nothing."""
    try:
        with mock.patch('csgm_ros.registration.schedule', return_value=[Attempt()]):
            result = register(
                case.source,
                case.target,
                replaced(config_of(case), EVERYTHING),
                seed=seed,
                details=True,
                source_viewpoint=case.eyes[0],
                target_viewpoint=case.eyes[1],
            )
    except CsgmError:
        return None
    if result.details is None:
        return None
    others = [hypothesis.transform.matrix for hypothesis in result.details.hypotheses]
    return Trial('searched', result.T_target_source, np.array(others).reshape(-1, 4, 4))


def planted(case: Case, view: View) -> list[Trial]:
    """Return winners of known origin: the best of each family that is wrong, and the truth."""
    rng = np.random.default_rng([3, *case.name.encode()])
    families = {name: _refined(case, view, changes) for name, changes in _families(case, rng).items()}
    trials = []
    wrong = {name: [m for m in found if not near(m, case)] for name, found in families.items()}
    wrong = {name: _ranked(view, found) for name, found in wrong.items()}
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
    slides = [_slide(sign * share * size * axis) for axis in along.T for share in (0.25, 0.5, 0.9) for sign in (1, -1)]
    turns = [_about(middle, _turn(axis, angle)) for axis in along.T for angle in (60, 90, 120, 180, 240, 270, 300)]
    factors = () if case.rigid else (0.8, 0.88, 1.14, 1.25)
    scales = [_about(middle, factor * np.eye(3)) for factor in factors]
    anywhere = []
    for place in case.target[rng.integers(len(case.target), size=24)]:
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


def _refined(case: Case, view: View, transforms: np.ndarray) -> list[np.ndarray]:
    found = []
    for transform in transforms:
        inner = normal(view, transform)
        comparison, scale = view.comparison(inner.scale)
        shrink = np.diag([scale, scale, scale, 1.0])
        start = (inner.matrix @ np.linalg.inv(shrink))[None]
        moved = refined(comparison, start, DISTANCES, refine_between, estimate_scale=not case.rigid)[0]
        found.append(view.pair.in_own_units(Similarity.from_matrix(moved @ shrink)).matrix)
    return found


def _ranked(view: View, transforms: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Sort transforms by their score, best first."""
    scored = []
    for transform in transforms:
        inner = normal(view, transform)
        comparison, scale = view.comparison(inner.scale)
        reduced = inner.matrix @ np.diag([1 / scale, 1 / scale, 1 / scale, 1.0])
        scored.append((comparison.agreement(reduced).score, transform))
    return [transform for _, transform in sorted(scored, key=lambda item: -item[0])]


def normal(view: View, transform: np.ndarray) -> Similarity:
    """Return a (4, 4) transform between own units as one between the normalised clouds."""
    source, target = view.pair.normalizations
    return target @ Similarity.from_matrix(transform) @ source.inverse()


# --- the cache: a file of clouds and transforms for each case, and one of findings for each state of the evidence


def save(path: Path, case: Case, trials: list[Trial]) -> None:
    """Write a case and its trials."""
    eyes = [np.full(3, np.nan) if eye is None else eye for eye in case.eyes]
    facts = {key: getattr(case, key) for key in ('name', 'kind', 'half', 'determined', 'rigid', 'real', 'related')}
    np.savez_compressed(
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


def judged(case: Case, trials: Iterable[Trial], view: View) -> list[dict]:
    """Return everything that is found out about the winners of one case, probed whether or not that is needed."""
    rows = []
    for trial in trials:
        inner = normal(view, trial.winner)
        others = [normal(view, other) for other in trial.others]
        start = time.process_time()
        findings = view.probed(inner, others, view.compared(inner, others))
        cpu = time.process_time() - start
        rows.append(
            {
                'case': case.name,
                'kind': case.kind,
                'half': case.half,
                'setting': trial.setting,
                'right': right(trial.winner, case),
                'rigid': case.rigid,
                'cpu': round(cpu, 3),
                'findings': asdict(findings),
                **_ratio_rule(view, inner, others),
            }
        )
    return rows


def _ratio_rule(view: View, winner: Similarity, others: Iterable[Similarity]) -> dict:
    """Return what version 0.1.0 would have said: shares of points, and their ratio to the best different transform."""
    best, probe = view.measure(winner), view.surfaces[0].probe
    measured = [view.measure(other) for other in others]
    rivals = [
        other.score
        for other in measured
        if other.score > 1.25 * best.score or winner.displacement(other.transform, probe) > 0.2
    ]
    strongest = max([0.05, *rivals])
    old = best.fitness >= 0.2 and best.score >= 1.25 * strongest and best.score - strongest >= 0.02
    return {'old': bool(old), 'fitness': [best.fitness_source, best.fitness_target]}


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
