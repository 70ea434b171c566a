"""The nouns that flow between the stages: frozen, validated, without behaviour of their own.

One sentence fixes every direction: ``x_target = s * R @ x_source + t``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from csgm_ros.config import Config


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity transform, ``x_target = scale * rotation @ x_source + translation``.

    Attributes
    ----------
    scale : float
        Target units per source unit, > 0.
    rotation : (3, 3) ndarray
        Proper rotation.
    translation : (3,) ndarray
        In target units; acts on the already scaled and rotated source.

    Examples
    --------
    >>> quarter_turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> transform = Similarity(2.0, quarter_turn, np.array([5.0, 0.0, 0.0]))
    >>> transform.apply(np.array([[1.0, 0.0, 0.0]])).tolist()
    [[5.0, 2.0, 0.0]]
    >>> (transform.inverse() @ transform).matrix.tolist() == np.eye(4).tolist()
    True
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def identity(cls) -> Similarity:
        """Return the transform that moves nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> Similarity:
        """Split a homogeneous (4, 4) similarity matrix."""
        matrix = np.asarray(matrix, float)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return cls(scale, matrix[:3, :3] / scale, matrix[:3, 3].copy())

    @classmethod
    def from_quaternion(cls, quaternion: np.ndarray, translation: np.ndarray, scale: float = 1.0) -> Similarity:
        """Return the transform of a quaternion (x, y, z, w) of any length but zero, as ROS orders it."""
        x, y, z, w = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(scale, rotation, np.asarray(translation, float))

    @property
    def matrix(self) -> np.ndarray:
        """The homogeneous (4, 4) matrix ``T_target_source``."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move (N, 3) source points into the target's frame and unit."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def inverse(self) -> Similarity:
        """Return the transform from target to source."""
        scale = 1.0 / self.scale
        return Similarity(scale, self.rotation.T, -scale * (self.rotation.T @ self.translation))

    def displacement(self, other: Similarity, points: np.ndarray) -> float:
        """Return the RMS distance between (N, 3) source points under this and another transform, target units."""
        return float(np.sqrt(((self.apply(points) - other.apply(points)) ** 2).sum(1).mean()))

    def __matmul__(self, other: Similarity) -> Similarity:
        """Compose: ``(a @ b).apply(x) == a.apply(b.apply(x))``."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle of a (3, 3) rotation in radians, accurate near zero and pi."""
    sine = np.linalg.norm(rotation - rotation.T) / np.sqrt(8.0)
    return float(np.arctan2(sine, (np.trace(rotation) - 1.0) / 2.0))


@dataclass(frozen=True, eq=False)
class Cloud:
    """A decoded cloud, finite points only.

    Attributes
    ----------
    points : (N, 3) float64 ndarray
        In the unit of the message (metres by REP-103; an SfM cloud has a unit of its own).
    colors : (N, 3) uint8 ndarray or None
        Red, green, blue; None where the message carries none.
    frame_id : str
        Coordinate frame of the points.
    stamp : int
        Nanoseconds.
    dropped : int
        Points left out because a coordinate was NaN or infinite (REP-117).
    """

    points: np.ndarray
    colors: np.ndarray | None = None
    frame_id: str = ''
    stamp: int = 0
    dropped: int = 0


@dataclass(frozen=True, eq=False)
class NormalizedPair:
    """Source and target after step 1.

    Attributes
    ----------
    clouds : pair of (N, 3) ndarray
        Finite points in the clouds' own units, outliers left out.
    normalizations : pair of Similarity
        From each own unit to a frame in which the cloud is centred and has radius 1.
    exchanged : bool
        The first cloud is the target of whoever asked: the search has an order of its own.
    """

    clouds: tuple[np.ndarray, np.ndarray]
    normalizations: tuple[Similarity, Similarity]
    exchanged: bool = False

    @cached_property
    def normalized(self) -> tuple[np.ndarray, np.ndarray]:
        """The points in the normalised frames."""
        source, target = (unit.apply(cloud) for cloud, unit in zip(self.clouds, self.normalizations, strict=True))
        return source, target

    def in_own_units(self, transform: Similarity) -> Similarity:
        """Return a transform between the normalised clouds as one between the clouds as they were given."""
        source, target = self.normalizations
        return target.inverse() @ transform @ source


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A cloud as the stages see it: centred, radius 1, one point a voxel.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        Voxel means and unit normals of arbitrary sign.
    """

    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class Supervoxels:
    """A cloud cut into supervoxels: the macro and micro structure (Sec. III-B).

    Attributes
    ----------
    labels : (N,) int32 ndarray
        Supervoxel of each input point, -1 where the flow did not reach.
    centroids, normals : (n, 3) ndarray
        Mean position and unit mean normal of each supervoxel.
    sizes : (n,) int64 ndarray
        Voxels in each supervoxel.
    adjacency : (m, 2) int32 ndarray
        Directed edges (start, end); each adjacent pair occurs once, "without flowing back".
    voxel_points, voxel_normals : (v, 3) ndarray
        The voxel centroids the segmentation worked on and their unit normals (NaN where undefined).
    voxel_labels : (v,) int32 ndarray
        Supervoxel of each voxel, -1 for none.
    point_voxels : (N,) int32 ndarray
        Voxel of each input point.
    """

    labels: np.ndarray
    centroids: np.ndarray
    normals: np.ndarray
    sizes: np.ndarray
    adjacency: np.ndarray
    voxel_points: np.ndarray
    voxel_normals: np.ndarray
    voxel_labels: np.ndarray
    point_voxels: np.ndarray

    def __len__(self) -> int:
        return len(self.centroids)


@dataclass(frozen=True, eq=False)
class Structure:
    """Macro and micro structure of one cloud in its normalised frame (Sec. III-B).

    Attributes
    ----------
    surface : PreparedCloud
        The voxels that the supervoxels were grown from.
    labels : (v,) int ndarray
        Supervoxel of each voxel, -1 for none.
    nodes, normals : (n, 3) ndarray
        Centroids and unit normals of the supervoxels.
    descriptors : (n, d_p) ndarray
        What describes each node: P of the paper.
    adjacency : (m, 2) int32 ndarray
        Directed edges between touching supervoxels.
    unit : float
        Length to which the configured ones are relative, here.
    normalization : Similarity
        From the cloud's own unit to this frame.
    """

    surface: PreparedCloud
    labels: np.ndarray
    nodes: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray
    adjacency: np.ndarray
    unit: float
    normalization: Similarity


@dataclass(frozen=True, eq=False)
class StructureGraph:
    """Nodes with micro-structure descriptors, directed edges with macro-structure descriptors (Sec. III-C).

    Attributes
    ----------
    nodes, normals : (n, 3) ndarray
        Centroids and normals of the supervoxels, in the cloud's own unit.
    node_descriptors : (n, d_p) ndarray
        P of the paper, one row a node.
    edges : (m, 2) int32 ndarray
        Directed edges, 0-based (start, end): the incidence matrices G and H as indices.
    edge_descriptors : (m, d_q) ndarray
        Q of the paper, one row an edge.
    """

    nodes: np.ndarray
    normals: np.ndarray
    node_descriptors: np.ndarray
    edges: np.ndarray
    edge_descriptors: np.ndarray


class NearestGrid(NamedTuple):
    """A cloud with its look-up table; -1 in ``index`` where no point lies within reach.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
        The cloud.
    index : pair of (a, b, c) and (k, d) int32 ndarray
        Which of the kept blocks of cells each block of the space is, the empty one being the first; the nearest point
        of each cell of those.
    origin : (3,) ndarray
        Lower corner of the grid.
    cell : float
        Edge of a cell.
    """

    points: np.ndarray
    normals: np.ndarray
    index: tuple[np.ndarray, np.ndarray]  # type: ignore[assignment]  # hides tuple.index, which nobody asks for
    origin: np.ndarray
    cell: float


@dataclass(frozen=True, eq=False)
class Surface:
    """A finely sampled cloud of radius about 1 and what can be told from it about the surface.

    Attributes
    ----------
    points, normals : (N, 3) ndarray
    tree : cKDTree
        Of the points, for exact nearest points.
    grid : NearestGrid
        Of the points, for quick ones.
    sample : (S,) index array
        The points that are measured.
    gap : float
        How far aside of a point the surface still is: the distance to its fourth neighbour, as far as that exceeds
        the inlier distance, and at most twice that. 0 where noise hides how the surface goes on.
    bend : float
        Median angle in degrees between the normals across the neighbourhoods that these were estimated from:
        curvature, and noise.
    """

    points: np.ndarray
    normals: np.ndarray
    tree: Any
    grid: NearestGrid
    sample: np.ndarray
    gap: float
    bend: float

    @property
    def probe(self) -> np.ndarray:
        """The (S, 3) points that are measured."""
        return self.points[self.sample]


@dataclass(frozen=True, eq=False)
class Matching:
    """A one-to-one assignment of the nodes of two graphs (Sec. III-D).

    Attributes
    ----------
    assignment : (n1, n2) uint8 ndarray
        X of the paper: 0/1, every row and column sums to at most one.
    objective : float
        J(X) of Eq. (4) on the given affinities.
    iterations : int
        Frank-Wolfe steps taken.
    path : (a, 2) ndarray
        alpha, and J of the relaxed X there, on the given affinities.
    """

    assignment: np.ndarray
    objective: float
    iterations: int
    path: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def pairs(self) -> np.ndarray:
        """(k, 2) int array of matched node indices (graph 1, graph 2)."""
        return np.argwhere(self.assignment)


@dataclass(frozen=True, eq=False)
class MatchedGraphs:
    """Two graphs, how alike their parts are, and the matching that was found from that alone.

    Attributes
    ----------
    source, target : StructureGraph
    node_affinity, edge_affinity : (n1, n2), (m1, m2) ndarray
        K_p and K_q, Eq. (2) and Eq. (3); K_p with the support of other nodes, where that is asked for.
    matching : Matching
    """

    source: StructureGraph
    target: StructureGraph
    node_affinity: np.ndarray
    edge_affinity: np.ndarray
    matching: Matching


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
        Parameter that the threshold comes from; empty where none does.
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
class Undetermined:
    """The one direction in which clouds leave a pose open that is right otherwise.

    Attributes
    ----------
    kind : str
        slide, turn or scale.
    direction : (3,) ndarray
        Of the slide, or axis of the turn, in the target's frame; zeros for a scale.
    low, high : float
        Range that fits as well: lengths in target units from the given transform, degrees, or target units per source
        unit.
    """

    kind: str
    direction: np.ndarray
    low: float
    high: float


@dataclass(frozen=True)
class Verdict:
    """Whether a transform is right, and why.

    Attributes
    ----------
    accepted : bool
        True only where the evidence is beyond the configured thresholds; False is the safe answer.
    reason : str
        One line for a person.
    fitness_source, fitness_target : float
        Share of the source lying on the target, and of the target lying on the source, in [0, 1].
    inlier_rmse : float
        RMS distance of the inliers, target units.
    margin : float
        Score of the transform over that of the best *different* one that was found or probed.
    terms : tuple of Term
        The evidence against its thresholds.
    confidence : float
        Calibrated probability that the transform is right, in [0, 1].
    undetermined : Undetermined or None
        Where the transform is right but for one direction: which, and how far; it is rejected all the same.
    """

    accepted: bool
    reason: str
    fitness_source: float
    fitness_target: float
    inlier_rmse: float
    margin: float
    terms: tuple[Term, ...] = ()
    confidence: float = 0.0
    undetermined: Undetermined | None = None


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A transform that was in question.

    Attributes
    ----------
    transform : Similarity
        Source to target, own units.
    score : float
        Hypotheses are ranked by it; larger is better.
    fitness_source, fitness_target : float
        Share of either cloud that lies on the other, in [0, 1].
    ratio : float
        How well it fits beside the answer, as the verdict counts it: independent surfaces.
    """

    transform: Similarity
    score: float
    fitness_source: float
    fitness_target: float
    ratio: float = 1.0


@dataclass(frozen=True, eq=False)
class Details:
    """How a result came about, for people; see the ``details`` of :func:`csgm_ros.register`.

    Attributes
    ----------
    structures : pair of Structure
        Source and target, in their normalised frames.
    graphs : MatchedGraphs
        Their matching is the one found without knowing the transform.
    hypotheses : tuple of Hypothesis
        The answer, then what competed with it, best first.
    inlier_distance, match_distance : float
        Target units, up to which a point lies on the other cloud and a match agrees.
    """

    structures: tuple[Structure, Structure]
    graphs: MatchedGraphs
    hypotheses: tuple[Hypothesis, ...]
    inlier_distance: float
    match_distance: float


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """What :func:`csgm_ros.register` returns.

    Attributes
    ----------
    transform : Similarity
        ``x_target = scale * rotation @ x_source + translation``. The best estimate even when rejected:
        look at ``accepted`` first.
    verdict : Verdict
        Acceptance, reason and the numbers behind it.
    timings : dict of str to float
        Wall seconds per stage, in order.
    seed : int
        Seed of the random generator.
    config : Config
        The whole configuration used.
    source_graph, target_graph : StructureGraph or None
        The matched graphs, in the clouds' own units.
    matches : (k, 2) int ndarray
        Matched nodes (source, target) of a matching guided by ``transform``: which supervoxels are one place. How many
        of the nodes have one says about as much as the fitness.
    match_inliers : (k,) bool ndarray
        Which matches agree with ``transform``.
    unguided_matches, unguided_inliers : (k, 2) int, (k,) bool ndarray
        The same before the transform was known: few need to agree, as hypotheses come from triples of them, of their
        next-best partners and of local features.
    details : Details or None
        On request only.
    """

    transform: Similarity
    verdict: Verdict
    timings: dict[str, float]
    seed: int
    config: Config
    source_graph: StructureGraph | None = None
    target_graph: StructureGraph | None = None
    matches: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    match_inliers: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    unguided_matches: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))
    unguided_inliers: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    details: Details | None = None

    @property
    def T_target_source(self) -> np.ndarray:  # noqa: N802 - the frame is part of the name
        """Homogeneous (4, 4) similarity."""
        return self.transform.matrix

    @property
    def scale(self) -> float:
        """Target units per source unit."""
        return self.transform.scale

    @property
    def accepted(self) -> bool:
        """True when the result may be used."""
        return self.verdict.accepted

    @property
    def reason(self) -> str:
        """Why it was accepted or rejected."""
        return self.verdict.reason

    @property
    def confidence(self) -> float:
        """Probability that the transform is right, in [0, 1]."""
        return self.verdict.confidence

    @property
    def undetermined(self) -> Undetermined | None:
        """The one direction that the clouds leave open, where it is only one."""
        return self.verdict.undetermined

    @property
    def fitness_source(self) -> float:
        """Share of the source that lies on the target."""
        return self.verdict.fitness_source

    @property
    def fitness_target(self) -> float:
        """Share of the target that lies on the source."""
        return self.verdict.fitness_target

    @property
    def seconds(self) -> float:
        """Wall seconds of the whole registration."""
        return sum(self.timings.values())


@dataclass(frozen=True, eq=False)
class Prior:
    """Where a transform is expected: it narrows the search and is no evidence.

    Everything else competes with what lies near it all the same, and nothing far from it is an answer.

    Attributes
    ----------
    transform : Similarity
        ``x_target = scale * rotation @ x_source + translation``.
    sigma : tuple of float
        Standard deviations of the place of the source's centre (target units; 0: a fifth of the target's radius), of
        the direction (degrees) and of the scale (relative).
    """

    transform: Similarity
    sigma: tuple[float, float, float]

    def allows(self, transform: Similarity, at: np.ndarray) -> bool:
        """Return whether a transform moves the source point ``at`` (3,) to within three sigma."""
        shift = np.linalg.norm(transform.apply(at[None]) - self.transform.apply(at[None]))
        angle = np.degrees(rotation_angle(transform.rotation @ self.transform.rotation.T))
        growth = abs(np.log(transform.scale / self.transform.scale))
        return bool(np.all(np.array((shift, angle, growth)) <= 3.0 * np.array(self.sigma)))


@dataclass(frozen=True, eq=False)
class Estimate:
    """What :meth:`csgm_ros.Session.add` says of one frame.

    Attributes
    ----------
    stamp : float
        Of the frame, seconds.
    state : str
        ``lost``, ``localizing`` or ``tracking``.
    reason : str
        Why the session is in this state, one line.
    T_map_sensor : (4, 4) ndarray or None
        Similarity from sensor metres to map units; None unless tracking.
    scale, scale_sigma : float
        Map units a metre and its standard deviation; NaN while unknown.
    covariance : (6, 6) ndarray or None
        Of a small translation (metres) and rotation (radians) of the sensor, along and about the map's axes.
    on_map, agreement : float
        Share of the frame's points near the map, and share of the map's points in view that the frame saw rather
        than saw through.
    seconds : float
        Work on this frame.
    """

    stamp: float
    state: str
    reason: str
    T_map_sensor: np.ndarray | None
    scale: float
    scale_sigma: float
    covariance: np.ndarray | None
    on_map: float
    agreement: float
    seconds: float
