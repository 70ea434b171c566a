"""What a report shows, as plain values: no stage of the pipeline is asked again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from csgm_ros.io.files import CloudFile
from csgm_ros.types import Similarity, StructureGraph


@dataclass(frozen=True, eq=False)
class Pose:
    """One transform that was in question.

    Attributes
    ----------
    transform : Similarity
        Source to target, own units.
    score : float
        What the candidates are ranked by; larger is better.
    fitness_source, fitness_target : float
        Share of either cloud that lies on the other, in [0, 1].
    """

    transform: Similarity
    score: float
    fitness_source: float
    fitness_target: float


@dataclass(frozen=True)
class Term:
    """One term of the evidence and its threshold.

    Attributes
    ----------
    name : str
        For a person.
    value, threshold : float
    at_least : bool
        The value must reach the threshold; else it must not exceed it.
    parameter : str
        Name of the parameter that holds the threshold; empty where none does.
    """

    name: str
    value: float
    threshold: float
    at_least: bool = True
    parameter: str = ''

    @property
    def passed(self) -> bool:
        """Whether the value is on the right side."""
        return self.value >= self.threshold if self.at_least else self.value <= self.threshold


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
    poses : tuple of Pose
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
    unguided : (int, int) or None
        How many matches agree of those made without knowing the answer, and of how many.
    node_affinity, edge_affinity, assignment : ndarray or None
        K_p, K_q and X of the paper.
    path : (a, 2) ndarray or None
        alpha, and J of the permutation that is nearest to it.
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
    poses: tuple[Pose, ...]
    terms: tuple[Term, ...]
    inlier_distance: float
    match_distance: float
    segmentations: tuple[Segmentation, Segmentation] | None = None
    graphs: tuple[StructureGraph, StructureGraph] | None = None
    matches: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    match_inliers: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    unguided: tuple[int, int] | None = None
    node_affinity: np.ndarray | None = None
    edge_affinity: np.ndarray | None = None
    assignment: np.ndarray | None = None
    path: np.ndarray | None = None
    timings: dict[str, float] = field(default_factory=dict)
    parameters: dict = field(default_factory=dict)
    defaults: dict = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)
