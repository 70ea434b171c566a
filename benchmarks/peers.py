"""Other people's registration methods behind one signature, each given its best chance.

Every method gets the problem as the product's own first step would hand it on: both clouds centred and divided
by their own radius (Eq. (1)); so its voxel and gate sizes are shares of the radius. A name that ends in
``+sicp`` is followed by scaled point-to-point ICP with shrinking gates, which none of the tools does by itself.
Methods whose library is not installed are left out; nothing here is needed by the product.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np

from benchmarks.datasets import similarity
from benchmarks.metrics import radius

VOXEL = 0.03
"""Voxel of the feature-based methods, share of the radius."""
DENSE_VOXEL = 0.01
"""Voxel of the point-based refinements, share of the radius."""
GATES = (0.05, 0.02, 0.01)
"""Gates of the scaled ICP, shares of the radius: wider ones shrink the source."""
CPD_POINTS = JRMPC_POINTS = 1000
"""Points left for the methods whose every iteration compares all with all: half of the paper's 2,000, for time."""
JRMPC_CENTRES = 250
"""Components of the mixture of JR-MPC."""

Method = Callable[[np.ndarray, np.ndarray, int, float], np.ndarray]
"""Normalised source and target, seed, voxel -> (4, 4) transform."""


def available() -> tuple[str, ...]:
    """Return the names of the peers whose library is installed, ``+sicp`` variants included."""
    have_open3d = importlib.util.find_spec('open3d') is not None
    names = [name for name, (library, _) in PEERS.items() if importlib.util.find_spec(library) is not None]
    return tuple(name + suffix for suffix in (('', '+sicp') if have_open3d else ('',)) for name in names)


def register(
    name: str, source: np.ndarray, target: np.ndarray, seed: int, *, rigid: bool = False, voxel: float = VOXEL
) -> np.ndarray:
    """Return the (4, 4) similarity from source to target that a peer finds.

    Parameters
    ----------
    name : str
        One of :func:`available`.
    source, target : (N, 3), (M, 3) ndarray
        The clouds, in any unit.
    seed : int
        Seed of the method's random generator.
    rigid : bool
        The clouds share a unit: both are divided by the target's radius and the scale stays 1.
    voxel : float
        Voxel of the methods that match features, share of the radius.
    """
    base, _, refinement = name.partition('+')
    unit_target = radius(target)
    unit_source = unit_target if rigid else radius(source)
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    source, target = (source - centre_source) / unit_source, (target - centre_target) / unit_target
    estimate = PEERS[base][1](source, target, seed, voxel)
    if refinement:
        estimate = scaled_icp(source, target, estimate, with_scaling=not rigid)
    into = similarity(1 / unit_source, np.eye(3), -centre_source / unit_source)
    out = similarity(unit_target, np.eye(3), centre_target)
    return out @ estimate @ into


def scaled_icp(source: np.ndarray, target: np.ndarray, start: np.ndarray, *, with_scaling: bool = True) -> np.ndarray:
    """Refine by point-to-point ICP with scale, one gate after the other."""
    from open3d.pipelines import registration

    source, target = _cloud(source, DENSE_VOXEL), _cloud(target, DENSE_VOXEL)
    estimation = registration.TransformationEstimationPointToPoint(with_scaling)
    criteria = registration.ICPConvergenceCriteria(1e-6, 1e-6, 30)
    for gate in GATES:
        start = registration.registration_icp(source, target, gate, start, estimation, criteria).transformation
    return np.array(start)


def _cloud(points: np.ndarray, voxel: float):
    import open3d

    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(points)
    return cloud.voxel_down_sample(voxel)


def _features(points: np.ndarray, voxel: float):
    """Voxel-thinned cloud and its FPFH; normals point towards the centroid, without which FPFH is arbitrary."""
    import open3d

    cloud = _cloud(points, voxel)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    search = open3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
    return cloud, open3d.pipelines.registration.compute_fpfh_feature(cloud, search)


def _fgr(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    import open3d
    from open3d.pipelines import registration

    open3d.utility.random.seed(seed)
    source, source_features = _features(source, voxel)
    target, target_features = _features(target, voxel)
    option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5 * voxel)
    result = registration.registration_fgr_based_on_feature_matching(
        source, target, source_features, target_features, option
    )
    return np.array(result.transformation)


def _ransac(with_scaling: bool) -> Method:
    def method(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
        import open3d
        from open3d.pipelines import registration

        open3d.utility.random.seed(seed)
        source, source_features = _features(source, voxel)
        target, target_features = _features(target, voxel)
        checkers = [registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel)]
        if not with_scaling:
            checkers.append(registration.CorrespondenceCheckerBasedOnEdgeLength(0.9))
        result = registration.registration_ransac_based_on_feature_matching(
            source,
            target,
            source_features,
            target_features,
            True,
            1.5 * voxel,
            registration.TransformationEstimationPointToPoint(with_scaling),
            3,
            checkers,
            registration.RANSACConvergenceCriteria(100000, 0.999),
        )
        return np.array(result.transformation)

    return method


def _kiss_matcher(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel))
    solution = matcher.estimate(source.astype(np.float32), target.astype(np.float32))
    return similarity(1.0, np.array(solution.rotation), np.array(solution.translation).ravel())


def _teaser(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    import teaserpp_python
    from open3d.pipelines import registration

    source, source_features = _features(source, voxel)
    target, target_features = _features(target, voxel)
    matches = np.asarray(registration.correspondences_from_features(source_features, target_features, True))
    parameters = teaserpp_python.RobustRegistrationSolver.Params()
    parameters.noise_bound = voxel
    parameters.estimate_scaling = False
    solver = teaserpp_python.RobustRegistrationSolver(parameters)
    solver.solve(np.asarray(source.points)[matches[:, 0]].T, np.asarray(target.points)[matches[:, 1]].T)
    solution = solver.getSolution()
    return similarity(1.0, np.array(solution.rotation), np.array(solution.translation).ravel())


def _icp(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    from open3d.pipelines import registration

    criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, 100)
    estimation = registration.TransformationEstimationPointToPoint(False)
    clouds = _cloud(source, DENSE_VOXEL), _cloud(target, DENSE_VOXEL)
    return np.array(registration.registration_icp(*clouds, 0.3, np.eye(4), estimation, criteria).transformation)


def _small_gicp(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    import small_gicp

    result = small_gicp.align(
        target, source, downsampling_resolution=2 * DENSE_VOXEL, max_correspondence_distance=0.3, max_iterations=100
    )
    return np.array(result.T_target_source)


def _few(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    if len(points) <= 1.5 * count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


def _cpd(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    from pycpd import RigidRegistration

    clouds = _few(target, CPD_POINTS, seed), _few(source, CPD_POINTS, seed)
    problem = RigidRegistration(X=clouds[0], Y=clouds[1], w=0.2, max_iterations=50)
    _, (scale, rotation, translation) = problem.register()
    return similarity(float(scale), rotation.T, translation.ravel())


def _jrmpc(source: np.ndarray, target: np.ndarray, seed: int, voxel: float) -> np.ndarray:
    import jrmpc

    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(3, JRMPC_CENTRES))
    centres /= np.linalg.norm(centres, axis=0)
    views = [_few(points, JRMPC_POINTS, seed).T for points in (source, target)]
    result = jrmpc.jrmpc(views, X=centres, gamma=0.2, max_num_iter=100)
    first, second = (similarity(1.0, result.R[view], np.ravel(result.t[view])) for view in (0, 1))
    return np.linalg.inv(second) @ first


PEERS: dict[str, tuple[str, Method]] = {
    'fgr': ('open3d', _fgr),
    'ransac': ('open3d', _ransac(False)),
    'ransac-scale': ('open3d', _ransac(True)),
    'kiss': ('kiss_matcher', _kiss_matcher),
    'teaser': ('teaserpp_python', _teaser),
    'icp': ('open3d', _icp),
    'gicp': ('small_gicp', _small_gicp),
    'cpd': ('pycpd', _cpd),
    'jrmpc': ('jrmpc', _jrmpc),
}
"""Name -> (importable library, method on normalised clouds)."""
