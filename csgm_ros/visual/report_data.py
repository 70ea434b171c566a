"""What a report shows, as plain values: no stage of the pipeline is asked again."""

from __future__ import annotations

import contextlib
import platform
from dataclasses import dataclass, field, replace
from importlib import metadata

import numpy as np

from csgm_ros.config import flatten, profile
from csgm_ros.errors import InputError
from csgm_ros.io.files import CloudFile
from csgm_ros.types import Hypothesis, RegistrationResult, StructureGraph, Term


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A cloud cut into supervoxels.

    Attributes
    ----------
    points : (V, 3) ndarray
        Voxels in the cloud's own unit.
    labels : (V,) int ndarray
        Supervoxel of each voxel, -1 for none.
    """

    points: np.ndarray
    labels: np.ndarray


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything a report shows; what is None or empty is left out of the page.

    Attributes
    ----------
    names : (str, str)
        What source and target are called, such as their files.
    source, target : CloudFile
        As they came.
    accepted : bool
    reason : str
        One line.
    poses : tuple of Hypothesis
        The answer, then what competed with it, best first.
    terms : tuple of Term
        The evidence against its thresholds.
    inlier_distance : float
        Target units, of the surfaces.
    match_distance : float
        Target units, up to which a match agrees with a transform.
    segmentations : pair of Segmentation, optional
    graphs : pair of StructureGraph, optional
        In the clouds' own units.
    matches : (k, 2) int ndarray
        Matched nodes (source, target).
    match_inliers : (k,) bool ndarray
        Which of them agree with the answer.
    unguided_matches, unguided_inliers : (k, 2) int, (k,) bool ndarray
        The same of those made without knowing the answer.
    node_affinity, edge_affinity, assignment : ndarray or None
        K_p, K_q and X of the paper.
    path : (a, 2) ndarray or None
        alpha, and J of X there.
    timings : dict of str to float
        Wall seconds per stage.
    parameters, defaults : dict
        Dotted name to value.
    facts : dict of str to str
        Versions, seed and whatever else identifies the run.
    """

    names: tuple[str, str]
    source: CloudFile
    target: CloudFile
    accepted: bool
    reason: str
    poses: tuple[Hypothesis, ...]
    terms: tuple[Term, ...]
    inlier_distance: float
    match_distance: float
    segmentations: tuple[Segmentation, Segmentation] | None = None
    graphs: tuple[StructureGraph, StructureGraph] | None = None
    matches: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    match_inliers: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    unguided_matches: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    unguided_inliers: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    node_affinity: np.ndarray | None = None
    edge_affinity: np.ndarray | None = None
    assignment: np.ndarray | None = None
    path: np.ndarray | None = None
    timings: dict[str, float] = field(default_factory=dict)
    parameters: dict = field(default_factory=dict)
    defaults: dict = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)


def report_data(result: RegistrationResult, source: CloudFile, target: CloudFile, names: tuple[str, str]) -> ReportData:
    """Return what a report shows of a result that was made with ``details=True``."""
    details, config = result.details, result.config
    if details is None:
        raise InputError(f'there is nothing to draw: {result.reason}')
    assert result.source_graph is not None
    assert result.target_graph is not None
    first, second = (
        Segmentation(side.normalization.inverse().apply(side.surface.points), side.labels)
        for side in details.structures
    )
    facts = {'seed': str(result.seed), 'profile': config.profile, 'seconds': f'{result.seconds:.2f}', **versions()}
    return ReportData(
        names=names,
        source=source,
        target=target,
        accepted=result.accepted,
        reason=result.reason,
        poses=(replace(details.hypotheses[0], transform=result.transform), *details.hypotheses[1:]),
        terms=result.verdict.terms,
        inlier_distance=details.inlier_distance,
        match_distance=details.match_distance,
        segmentations=(first, second),
        graphs=(result.source_graph, result.target_graph),
        matches=result.matches,
        match_inliers=result.match_inliers,
        unguided_matches=result.unguided_matches,
        unguided_inliers=result.unguided_inliers,
        node_affinity=details.graphs.node_affinity,
        edge_affinity=details.graphs.edge_affinity,
        assignment=details.graphs.matching.assignment,
        path=details.graphs.matching.path,
        timings=result.timings,
        parameters=flatten(config),
        defaults=flatten(profile(config.profile)),
        facts=facts,
    )


def versions() -> dict[str, str]:
    """Return the versions of this package and of what its numbers depend on."""
    found = {'Python': platform.python_version(), 'machine': f'{platform.system()} {platform.machine()}'}
    for name in ('csgm_ros', 'numpy', 'scipy', 'numba', 'open3d', 'open3d-cpu'):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
