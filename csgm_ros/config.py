"""Every default, unit, bound and description, once.

The YAML files in ``config/``, the command line and the ROS parameters are all made from these dataclasses.
Lengths are relative to the cloud's radius (largest distance to the centroid, Sec. IV-A) unless a unit says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from csgm_ros import schema
from csgm_ros.errors import ConfigError
from csgm_ros.schema import Checked, flatten, param, parameter_fields, part_types

__all__ = ['Config', 'NodeConfig', 'configured', 'flatten', 'parameter_fields', 'profile', 'replaced']

RADIUS = 'radius of the cloud'
PROFILES = ('robust', 'paper')
MODES = ('pair', 'tracking')

# What can be chosen by name: the function that does it. A new one is a function and a line here.
DESCRIPTORS = {
    'esf': 'csgm_ros.structure.descriptors:of_supervoxels',
    'context': 'csgm_ros.structure.descriptors:of_surroundings',
}
HYPOTHESIS_SOURCES = {
    'graph': 'csgm_ros.transform.graph_source:propose',
    'local': 'csgm_ros.transform.local_source:propose',
    'parts': 'csgm_ros.transform.parts:propose',
    'planes': 'csgm_ros.transform.planes:propose',
    'prior': 'csgm_ros.transform.prior_source:propose',
    'volumes': 'csgm_ros.transform.volumes:propose',
}


@dataclass(frozen=True)
class PreprocessConfig(Checked):
    """What is done to a cloud before the five steps."""

    outlier_factor: float = param(
        2.5,
        'points whose neighbours are farther than this do not count for the radius; 0 keeps all outliers (the paper)',
        unit='median distance',
        low=0.0,
        high=1000.0,
    )
    max_points: int = param(
        1000000, 'points from which a cloud is thinned to one a voxel, of at most so many', low=1000, high=100000000
    )
    normal_neighbors: int = param(20, 'points from which a normal is estimated', low=3, high=200)
    max_surface_variation: float = param(
        0.6, 'surface variation above which smoothing is tried while no result is certain', low=0.0, high=1.0
    )
    smoothing: tuple[int, ...] = param(
        (40, 100), 'neighbours to smooth a noisy cloud with, tried one after the other', low=3, high=1000
    )


@dataclass(frozen=True)
class ScaleConfig(Checked):
    """Step 1, scale normalisation, Eq. (1)."""

    estimate_scale: bool = param(True, 'estimate the scale; false for sensors that share a unit (rigid mode)')
    scale_min: float = param(
        1e-6, 'smallest scale that a result may have', unit='target per source unit', low=1e-9, high=1e9
    )
    scale_max: float = param(
        1e6, 'largest scale that a result may have', unit='target per source unit', low=1e-9, high=1e9
    )
    prior: float = param(
        0.0, 'expected scale; 0 where nothing is known', unit='target per source unit', low=0.0, high=1e9
    )
    prior_factor: float = param(1.5, 'the scale is the prior times or by this', low=1.0, high=1e6)

    def __post_init__(self):
        super().__post_init__()
        if self.scale_min >= self.scale_max:
            raise ConfigError(f'scale_min {self.scale_min} must be below scale_max {self.scale_max}')
        if self.bounds[0] >= self.bounds[1]:
            raise ConfigError(
                f'prior {self.prior} with prior_factor {self.prior_factor} leaves nothing between scale_min '
                f'{self.scale_min} and scale_max {self.scale_max}: change either'
            )

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest scale that a result may have, the prior taken into account."""
        if self.prior == 0.0:
            return self.scale_min, self.scale_max
        return max(self.scale_min, self.prior / self.prior_factor), min(self.scale_max, self.prior * self.prior_factor)

    def exchanged(self) -> ScaleConfig:
        """Return the same for source and target exchanged: source per target unit."""
        prior = 1.0 / self.prior if self.prior else 0.0
        return replace(self, scale_min=1.0 / self.scale_max, scale_max=1.0 / self.scale_min, prior=prior)


@dataclass(frozen=True)
class SupervoxelConfig(Checked):
    """Step 2a, macro structure: supervoxels (VCCS) and their adjacency."""

    voxel_size: float = param(
        0.03, 'edge of the voxels that supervoxels are grown from', unit=RADIUS, low=0.002, high=0.2
    )
    seed_size: float = param(0.20, 'supervoxel radius: spacing of the seeds', unit=RADIUS, low=0.01, high=1.0)
    max_nodes: int = param(
        160, 'supervoxels of a cloud from which seed_size is enlarged to have fewer', low=10, high=1000
    )
    spatial_weight: float = param(0.4, 'weight of the distance to the supervoxel centre', low=0.0, high=100.0)
    normal_weight: float = param(1.0, 'weight of the angle between the normals', low=0.0, high=100.0)
    refinements: int = param(0, 'rounds of re-seeding at the centroids', low=0, high=10)


@dataclass(frozen=True)
class DescriptorConfig(Checked):
    """Step 2b, micro structure: what describes a node."""

    kind: str = param(
        'context',
        'esf: ESF-640 of the bare supervoxel (the paper); context: ESF and FPFH of its surroundings',
        choices=tuple(DESCRIPTORS),
    )
    context_radius: float = param(
        1.5, 'radius of the surroundings that describe a node', unit='seed_size', low=0.5, high=10.0
    )
    esf_samples: int = param(4000, 'random triples of points per ESF descriptor', low=100, high=1000000)


@dataclass(frozen=True)
class GraphConfig(Checked):
    """Step 3, graph construction and affinities, Eq. (2) and Eq. (3)."""

    edges: str = param(
        'neighbors',
        'adjacency: of the supervoxels (the paper); neighbors: nearest nodes, both directions',
        choices=('adjacency', 'neighbors'),
    )
    neighbors: int = param(6, 'edges that leave each node when edges is neighbors', low=1, high=50)
    edge_descriptor: str = param(
        'invariant',
        'euler: angles to the axes and length (the paper); invariant: length and angles with the normals',
        choices=('euler', 'invariant'),
    )
    similarity: str = param(
        'gaussian',
        'linear: 1 - D / max(D) (the paper); gaussian: exp(-D^2 / 2 sigma^2)',
        choices=('linear', 'gaussian'),
    )
    node_sigma: float = param(0.5, 'width of the Gaussian node similarity', unit='median of D', low=0.01, high=100.0)
    edge_sigma: float = param(0.6, 'width of the Gaussian edge similarity', unit='median of D', low=0.01, high=100.0)
    support: bool = param(
        True, 'nodes are the more alike the more pairs of others agree with them, and without such stay unmatched'
    )


@dataclass(frozen=True)
class MatchingConfig(Checked):
    """Step 4, enhanced factorised graph matching, Eq. (4) to Eq. (8)."""

    alpha_steps: int = param(
        41, 'values of alpha on the path from the concave to the convex relaxation', low=2, high=1001
    )
    frank_wolfe_iterations: int = param(10, 'Frank-Wolfe steps at most per alpha', low=1, high=10000)
    gap_tolerance: float = param(1e-3, 'duality gap at which Frank-Wolfe stops', unit='objective', low=0.0, high=1.0)
    smooth_weight: float = param(
        0.1, 'weight of J_smooth, Eq. (8); 0 turns it off, 1 is the paper', low=0.0, high=100.0
    )
    search_effort: float = param(
        20.0, 'most work of the search after the path; 0 turns it off', unit='million operations', low=0.0, high=1e6
    )


@dataclass(frozen=True)
class RansacConfig(Checked):
    """Step 5a, 3-D RANSAC on the matched centroids, with scale."""

    iterations: int = param(5000, 'random triples tried', low=10, high=10000000)
    inlier_distance: float = param(0.1, 'largest distance of an inlier', unit=RADIUS, low=0.001, high=1.0)


@dataclass(frozen=True)
class HypothesesConfig(Checked):
    """Step 5b, many hypotheses instead of one: where they come from and how many."""

    method: str = param(
        'search',
        'search: many hypotheses, verified from both sides; ransac: the one transform of RANSAC on the matched nodes '
        '(the paper)',
        choices=('search', 'ransac'),
    )
    sources: tuple[str, ...] = param(
        ('graph', 'local', 'planes', 'volumes', 'parts'),
        'where the search gets its hypotheses, one source after the other while nothing is certain; graph: triples of '
        'matched nodes and of their next-best correspondences; local: triples of keypoints with similar FPFH; planes: '
        'dominant planes on each other, then yaw, place and scale by correlation of layered occupancy; volumes: '
        'directions of planes on each other, then turn and place by correlation of volumes, where the scale is given; '
        'parts: as planes, those of the smaller cloud on any of the larger one; '
        'prior: near what is expected, always asked where there is a prior',
        choices=tuple(HYPOTHESIS_SOURCES),
    )
    correspondences: int = param(
        4,
        'putative correspondences of each keypoint, and of each node beside its match; 0: matched nodes alone (the '
        'paper), and no keypoints',
        low=0,
        high=50,
    )
    feature_radius: float = param(0.25, 'radius of a local feature', unit=RADIUS, low=0.02, high=1.0)
    scale_factor: float = param(
        2.0, 'scales searched are those of Eq. (1), whose error reaches 42 %, times or by this', low=1.0, high=20.0
    )
    plane_scale_factor: float = param(
        10.0,
        'the same for planes, which do not need the clouds to be about equally large',
        low=1.0,
        high=100.0,
    )
    relative_scales: tuple[float, ...] = param(
        (0.6, 1.6),
        'lengths tried, relative to the configured ones, while no result is certain; 1 adds none',
        low=0.05,
        high=20.0,
    )
    trials: int = param(250000, 'minimal samples (triples) drawn per source', low=100, high=100000000)
    limit: int = param(10000, 'hypotheses kept per relative scale and source', low=10, high=1000000)
    min_side: float = param(0.2, 'shortest side of a triple', unit=RADIUS, low=0.01, high=1.0)
    side_tolerance: float = param(0.2, 'how much the scales of the sides of a triple may differ', low=0.01, high=1.0)
    max_normal_angle: float = param(
        50.0, 'how much the normals of a triple may differ', unit='degree', low=1.0, high=90.0
    )


@dataclass(frozen=True)
class VerificationConfig(Checked):
    """Which hypothesis is right, and is it right at all."""

    coarse_samples: int = param(150, 'points of either side for the coarse score', low=20, high=100000)
    coarse_truncation: float = param(
        0.08,
        'distance from which the truncated linear score is 0 before the short ICP',
        unit=RADIUS,
        low=0.005,
        high=0.12,
    )
    refined: int = param(60, 'best different hypotheses that get a short ICP', low=1, high=10000)
    samples: int = param(700, 'points of either side in the short ICP and its score', low=20, high=1000000)
    max_correspondence_distances: tuple[float, ...] = param(
        (0.12, 0.08, 0.05), 'of the short ICP, one run after the other', unit=RADIUS, low=0.001, high=0.12
    )
    fine_truncation: float = param(
        0.04,
        'distance from which the truncated linear score is 0 after the short ICP',
        unit=RADIUS,
        low=0.001,
        high=0.12,
    )
    finalists: int = param(6, 'best different hypotheses that are measured on the fine clouds', low=1, high=100)
    distinct: float = param(0.1, 'RMS displacement up to which two hypotheses are one', unit=RADIUS, low=0.01, high=1.0)
    fine_voxel_size: float = param(0.012, 'voxel grid of the fine clouds', unit=RADIUS, low=0.001, high=0.2)
    fine_samples: int = param(4000, 'points of either side that are measured', low=100, high=10000000)
    inlier_distance: float = param(
        0.02, 'a point lies on the other cloud when it is this close', unit=RADIUS, low=0.001, high=0.12
    )
    max_normal_angle: float = param(40.0, 'and its normal differs by no more', unit='degree', low=1.0, high=90.0)
    normal_tolerance: float = param(
        1.5, 'nor by more than this', unit='median angle across a neighbourhood', low=0.1, high=1000.0
    )
    different: float = param(
        0.2,
        'RMS displacement from which two hypotheses are shown as different ones',
        unit=RADIUS,
        low=0.01,
        high=10.0,
    )
    min_planes: float = param(
        4.0, 'independent surfaces that agree, below which a result is rejected', low=0.0, high=1000.0
    )
    min_coverage: float = param(
        0.07,
        'share of all independent surfaces of the smaller cloud that agree, below which a result is rejected',
        low=0.0,
        high=1.0,
    )
    min_margin: float = param(
        2.2,
        'score over that of the best different transform, found or probed, below which a result is rejected',
        low=1.0,
        high=100.0,
    )
    min_significance: float = param(
        3.0,
        'logarithm of that over its own uncertainty, below which it is rejected too: the fewer surfaces agree, the '
        'more is asked for',
        low=0.0,
        high=100.0,
    )
    max_scale_ratio: float = param(
        0.75,
        'score at a scale 10 % or more off, relative to that at its own, above which a result is rejected',
        low=0.0,
        high=10.0,
    )
    max_mirrored: float = param(
        1.0,
        'score of the mirrored source, relative to that as it is, above which a result is rejected; '
        'below it too where few surfaces agree',
        low=0.0,
        high=100.0,
    )
    max_half_shift: float = param(
        0.7,
        'RMS displacement between refinements on halves of the structure above which a result is rejected',
        unit='cell',
        low=0.0,
        high=100.0,
    )
    max_seen_through: float = param(
        0.2,
        'share of points that a sensor with known viewpoint has looked through above which a result is rejected',
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class IcpConfig(Checked):
    """Step 5c, final ICP with shrinking correspondence distance."""

    estimate_scale: bool = param(True, 'refine the scale too; the paper leaves it at Eq. (1) and RANSAC')
    iterations: int = param(30, 'ICP iterations at most per run; 0 leaves the final ICP out', low=0, high=1000)
    max_correspondence_distances: tuple[float, ...] = param(
        (0.02, 0.01),
        'largest distance of a correspondence, one run after the other',
        unit=RADIUS,
        low=0.0005,
        high=1.0,
    )


@dataclass(frozen=True)
class TrackingConfig(Checked):
    """A moving sensor in a map, :class:`csgm_ros.Session`."""

    resolution: float = param(
        0.0125, 'edge of the voxels of a frame', unit='median range of the first frame', low=0.001, high=0.1
    )
    first_seconds: float = param(
        1.0, 'frames that are joined before the first attempt to localise', unit='s', low=0.0, high=60.0
    )
    most_seconds: float = param(3.0, 'newest frames that are joined at most', unit='s', low=0.1, high=60.0)
    max_gap: float = param(1.0, 'silence of the sensor after which it may be anywhere', unit='s', low=0.05, high=60.0)
    lost_after: float = param(0.8, 'time without evidence after which the pose is lost', unit='s', low=0.0, high=60.0)
    min_on_map: float = param(
        0.2, "share of a frame's points near the map below which the frame is no evidence", low=0.0, high=1.0
    )
    min_agreement: float = param(
        0.6, "share of the map's points in view that are seen, not seen through", low=0.0, high=1.0
    )
    confirmations: int = param(2, 'frames in a row that must confirm a localisation', low=1, high=100)


@dataclass(frozen=True)
class NodeConfig(Checked):
    """What only the ROS node needs, beside :class:`Config`."""

    mode: str = param(
        'pair',
        'pair: registers two clouds on request; tracking: follows a depth sensor through a map of any unit',
        choices=MODES,
    )
    autostart: bool = param(False, 'configure and activate at start, without a lifecycle manager')
    trigger: str = param(
        'on_request',
        'on_request: only by ~/register; on_first_pair: also once, when both clouds are there; on_new_source: also '
        'for every new source cloud; on_every_pair: also whenever either cloud is new. The newest pair wins',
        choices=('on_request', 'on_first_pair', 'on_new_source', 'on_every_pair'),
    )
    seed: int = param(0, 'seed of the random generator; the same clouds and seed give the same result', low=0)
    initial: str = param('', 'JSON file of where the transform (tracking: sensor to map) is expected; no evidence')
    initial_sigma: tuple[float, ...] = param(
        (0.0, 15.0, 0.1),
        "standard deviations of initial: place in target units (0: a fifth of the target's radius), degrees, relative "
        'scale',
        low=0.0,
        high=1e6,
    )
    publish_tf: bool = param(False, 'send the rigid part to /tf_static; TF cannot carry the scale')
    child_frame: str = param('', "frame of the scaled source; empty for the source's frame with _scaled appended")
    report_folder: str = param(
        '', 'folder that ~/save_report writes the page of the last registration to; empty: none is kept for it'
    )
    fixed_frame: str = param('', 'frame that accumulated clouds are moved into through TF; empty: they share a frame')
    source_viewpoint: str = param(
        '',
        "TF frame in whose origin the source's sensor stood: what it looked through is empty; empty: the cloud's own "
        'frame where its message is organised, as that of a depth camera is, else unknown',
    )
    target_viewpoint: str = param('', "the same for the target's sensor")
    source_window: int = param(1, 'newest messages of the source that are merged into one cloud', low=1, high=1000)
    target_window: int = param(1, 'newest messages of the target that are merged into one cloud', low=1, high=1000)
    max_points: int = param(
        10_000_000,
        'points from which a message is refused, and older ones leave a window; each costs about 50 bytes to decode',
        low=100,
        high=2**31 - 1,
    )
    window_voxel: float = param(
        0.002, 'edge of the voxels in which merged messages are averaged', unit=RADIUS, low=0.0, high=0.1
    )
    map_file: str = param('', 'tracking: the map, a cloud or what `csgm prepare-map` wrote; empty: the topic map')
    map_frame: str = param('map', 'tracking: frame of a map that comes from a file')
    odom_frame: str = param('', 'tracking: frame of an odometry that TF tells of; empty: there is none')
    base_frame: str = param('', "tracking: frame whose pose is given out; empty: the sensor's")
    tf_broadcast: bool = param(True, 'tracking: send the pose to /tf, as that of odom_frame where there is one')
    transform_tolerance: float = param(
        0.1, 'tracking: how far ahead the pose of odom_frame is dated', unit='s', low=0.0, high=10.0
    )
    diagnostics_period: float = param(1.0, 'time between two messages on /diagnostics', unit='s', low=0.05, high=60.0)
    input_timeout: float = param(
        5.0, 'silence of an input after which the node warns and names the remedy', unit='s', low=0.5, high=3600.0
    )

    def __post_init__(self):
        super().__post_init__()
        if len(self.initial_sigma) != 3:
            raise ConfigError(f'initial_sigma must hold place, degrees and scale, not {list(self.initial_sigma)}')


PAPER = {
    'preprocess': {'outlier_factor': 0.0},
    'descriptors': {'kind': 'esf', 'esf_samples': 20000},
    'graph': {'edges': 'adjacency', 'edge_descriptor': 'euler', 'similarity': 'linear', 'support': False},
    'matching': {
        'alpha_steps': 101,
        'frank_wolfe_iterations': 100,
        'gap_tolerance': 1e-6,
        'smooth_weight': 1.0,
        'search_effort': 0.0,
    },
    'hypotheses': {'method': 'ransac'},
    'icp': {'estimate_scale': False},
}


# Names of version 0.1: who uses one is told the new one.
RENAMED = {
    'preprocess.stray_factor': 'preprocess.outlier_factor',
    'preprocess.noise_threshold': 'preprocess.max_surface_variation',
    'hypotheses.partners': 'hypotheses.correspondences',
    'verification.coarse_distance': 'verification.coarse_truncation',
    'verification.score_distance': 'verification.fine_truncation',
    'verification.gates': 'verification.max_correspondence_distances',
    'icp.gates': 'icp.max_correspondence_distances',
}


@dataclass(frozen=True)
class Config(Checked):
    """Everything :func:`csgm_ros.register` can be told, one part a stage.

    A part that is not given has the values of the profile.
    """

    profile: str = param('robust', 'robust: the default; paper: the literal method, for comparison', choices=PROFILES)
    threads: int = param(0, 'threads at most; 0 takes every core. The result does not depend on it', low=0, high=256)
    time_budget: float = param(
        0.0,
        'seconds after which the best verified answer so far is judged; 0 for no limit',
        unit='s',
        low=0.0,
        high=86400.0,
    )
    preprocess: PreprocessConfig = None  # type: ignore[assignment]
    scale: ScaleConfig = None  # type: ignore[assignment]
    supervoxels: SupervoxelConfig = None  # type: ignore[assignment]
    descriptors: DescriptorConfig = None  # type: ignore[assignment]
    graph: GraphConfig = None  # type: ignore[assignment]
    matching: MatchingConfig = None  # type: ignore[assignment]
    ransac: RansacConfig = None  # type: ignore[assignment]
    hypotheses: HypothesesConfig = None  # type: ignore[assignment]
    verification: VerificationConfig = None  # type: ignore[assignment]
    icp: IcpConfig = None  # type: ignore[assignment]
    tracking: TrackingConfig = None  # type: ignore[assignment]

    def __post_init__(self):
        super().__post_init__()
        for name, kind in part_types(type(self)).items():
            if getattr(self, name) is None:
                own = PAPER.get(name, {}) if self.profile == 'paper' else {}
                object.__setattr__(self, name, kind(**own))


def profile(name: str = 'robust') -> Config:
    """Return the configuration of a profile, ``robust`` or ``paper``."""
    return Config(profile=name)


def configured(values: dict[str, Any], base: str | None = None) -> Config:
    """Return the configuration of a profile with dotted names replaced.

    Parameters
    ----------
    values : dict
        ``{'stage.name': value}``; ``profile`` among them chooses the profile below all others.
    base : str, optional
        Profile where ``values`` name none; default: robust.

    Raises
    ------
    ConfigError
        For a name that does not exist or a value out of its type or bounds; the message names it.
    """
    others = {name: value for name, value in values.items() if name != 'profile'}
    return replaced(profile(values.get('profile', base or 'robust')), others)


def replaced(config: Any, values: dict[str, Any]) -> Any:
    """Return ``config`` with dotted names replaced, checked as a whole.

    Raises
    ------
    ConfigError
        For a name that does not exist, an earlier name of a parameter, or a value out of its type or bounds; the
        message names it. The profile of a whole configuration cannot be replaced: it is what the others started from.

    Examples
    --------
    >>> replaced(profile(), {'scale.estimate_scale': False}).scale.estimate_scale
    False
    >>> replaced(profile(), {'icp.iterations': -1})
    Traceback (most recent call last):
    csgm_ros.errors.ConfigError: icp.iterations must lie in [0, 1000], not -1
    """
    renamed = [name for name in values if name in RENAMED]
    if renamed:
        raise ConfigError(f'{renamed[0]} is called {RENAMED[renamed[0]]} now')
    if 'profile' in values and values['profile'] != getattr(config, 'profile', None):
        raise ConfigError('profile: is chosen before all other parameters, by --profile or csgm_ros.profile(name)')
    return schema.replaced(config, values)
