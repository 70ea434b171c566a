"""One frame for many clouds: a pose graph over similarities in which some edges are wrong.

A node is a cloud and its pose a similarity, scale included: seven degrees of freedom. An edge is a registration,
``x_target = T x_source``. Its residual is how far the poses move points of the source from where the edge says they
are, relative to the spread of the source: rotation, scale and translation in one unit, which no choice of weights
between angles and lengths can bend. Minimised is the truncated sum of squares, by graduated non-convexity (Yang et
al., "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020) around Gauss-Newton steps that SciPy's sparse
LU solves; the start is the spanning tree of the edges that most of their triangles agree with.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from csgm_ros.types import Similarity

# corners of a regular tetrahedron, RMS distance 1 from the origin: what stands for the points of a cloud
CORNERS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
TRIANGLES = 50  # at most that vote on an edge
GRADUATION = 1.6  # factor between two degrees of non-convexity


@dataclass(frozen=True, eq=False)
class Edge:
    """One registration between two clouds of the graph.

    Attributes
    ----------
    source, target : int
        Nodes.
    transform : Similarity
        Source to target, each in its own unit.
    center, spread : (3,) ndarray, float
        Of the source's points: their mean and RMS distance to it.
    """

    source: int
    target: int
    transform: Similarity
    center: np.ndarray
    spread: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """Poses and what each edge turned out to be.

    Attributes
    ----------
    poses : list of Similarity
        From each node to its component's frame.
    component : (n,) int ndarray
        Nodes with the same number share a frame.
    residuals : (e,) ndarray
        RMS displacement of the source's points between edge and poses, relative to their spread; before a
        contradicted edge was cut.
    kept : (e,) bool ndarray
        Edges that hold the components together.
    verified : (e,) bool ndarray
        Kept edges that lie in a cycle of kept edges: a second way says the same.
    contradicted : (e,) bool ndarray
        Edges that were cut though the poses agree with them: they are the only way between two parts, and another
        edge between these parts says otherwise. Which of them is wrong cannot be told.
    """

    poses: list[Similarity]
    component: np.ndarray
    residuals: np.ndarray
    kept: np.ndarray
    verified: np.ndarray
    contradicted: np.ndarray


def align(count: int, edges: Sequence[Edge], tolerance: float = 0.1) -> Aligned:
    """Find the poses of ``count`` clouds that most edges agree with.

    Parameters
    ----------
    count : int
        Nodes.
    edges : sequence of Edge
        Some may be wrong.
    tolerance : float, optional
        Residual from which an edge is wrong, relative to the spread of its source.
    """
    frames = _own_frames(count, edges)
    unit = [frames[e.target] @ e.transform @ frames[e.source].inverse() for e in edges]
    ends = np.array([(e.source, e.target) for e in edges], int).reshape(-1, 2)
    graph = _Graph(ends, _stacked(unit))
    poses = _stacked(_start(count, ends, unit, tolerance))
    largest = max(graph.residuals(poses).max(initial=0.0), tolerance)
    mu = 1.0 / max(2.0 * (largest / tolerance) ** 2 - 1.0, 1e-12)
    while mu < 1e4:
        poses = graph.solved(poses, _weights(graph.residuals(poses), tolerance, mu), steps=1)
        mu *= GRADUATION
    for _ in range(5):
        kept = graph.residuals(poses) <= tolerance
        poses = graph.solved(poses, kept.astype(float), steps=10)
    residuals = graph.residuals(poses)
    kept = residuals <= tolerance
    verified, contradicted = _checked(count, ends, kept)
    kept &= ~contradicted
    component = _components(count, ends[kept])
    found = [Similarity(float(poses.scale[k]), poses.rotation[k], poses.translation[k]) for k in range(count)]
    found = [pose @ frame for pose, frame in zip(found, frames, strict=True)]
    return Aligned(found, component, residuals, kept, verified & kept, contradicted)


def path(count: int, ends: np.ndarray, usable: np.ndarray, start: int, end: int) -> list[int]:
    """Return the fewest usable edges that lead from one node to another; empty where none do."""
    reached: dict[int, int] = {start: -1}
    ways: list[list[int]] = [[] for _ in range(count)]
    for number in map(int, np.flatnonzero(usable)):
        for node in ends[number]:
            ways[node].append(number)
    row = [start]
    while row and end not in reached:
        following = []
        for node in row:
            for number in ways[node]:
                other = int(ends[number].sum() - node)
                if other not in reached:
                    reached[other] = number
                    following.append(other)
        row = following
    found = []
    while end != start and end in reached:
        found.append(int(reached[end]))
        end = int(ends[found[-1]].sum() - end)
    return found[::-1]


def _own_frames(count: int, edges: Sequence[Edge]) -> list[Similarity]:
    """Return the transforms that centre each cloud and give it spread 1: lengths and coordinates of no size."""
    frames: list[Similarity | None] = [None] * count
    for e in edges:
        if frames[e.source] is None:
            frames[e.source] = Similarity(1.0 / e.spread, np.eye(3), -np.asarray(e.center) / e.spread)
    for e in edges:
        if frames[e.target] is None:  # never a source: where its sources lie in it
            spread = e.spread * e.transform.scale
            center = e.transform.apply(np.asarray(e.center)[None])[0]
            frames[e.target] = Similarity(1.0 / spread, np.eye(3), -center / spread)
    return [frame or Similarity.identity() for frame in frames]


def _start(count: int, ends: np.ndarray, transforms: list[Similarity], tolerance: float) -> list[Similarity]:
    """Chain the edges of a spanning tree; those that most of their triangles agree with come first."""
    from scipy.cluster.hierarchy import DisjointSet

    votes = _votes(count, ends, transforms, tolerance)
    sets = DisjointSet(range(count))
    tree: list[list[tuple[int, Similarity]]] = [[] for _ in range(count)]
    for number in np.argsort(-votes, kind='stable'):
        source, target = ends[number]
        if sets.merge(source, target):
            tree[source].append((target, transforms[number].inverse()))
            tree[target].append((source, transforms[number]))
    poses: list[Any] = [None] * count  # a pose each, once the tree is walked
    for root in range(count):
        if poses[root] is not None:
            continue
        poses[root], stack = Similarity.identity(), [root]
        while stack:
            node = stack.pop()
            for other, transform in tree[node]:
                if poses[other] is None:
                    poses[other] = poses[node] @ transform
                    stack.append(other)
    return poses


def _votes(count: int, ends: np.ndarray, transforms: list[Similarity], tolerance: float) -> np.ndarray:
    """Return, for each edge, how many of its triangles close less how many do not."""
    to: list[dict[int, Similarity]] = [{} for _ in range(count)]
    for (source, target), transform in zip(ends, transforms, strict=True):
        to[source].setdefault(int(target), transform)
        to[target].setdefault(int(source), transform.inverse())
    votes = np.zeros(len(ends))
    for number, ((source, target), transform) in enumerate(zip(ends, transforms, strict=True)):
        for third in itertools.islice(sorted(to[source].keys() & to[target].keys()), TRIANGLES):
            around = to[third][int(target)] @ to[source][third]
            off = np.linalg.norm(around.apply(CORNERS) - transform.apply(CORNERS), axis=1) / transform.scale
            votes[number] += 1.0 if np.sqrt((off**2).mean()) <= 2.0 * tolerance else -1.0
    return votes


class _Stack(NamedTuple):
    """Many similarities: (k,) scales, (k, 3, 3) rotations, (k, 3) translations."""

    scale: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    def taken(self, numbers: np.ndarray) -> _Stack:
        return _Stack(*(part[numbers] for part in self))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move (k, m, 3) points, or the same (m, 3) by each."""
        turned = points @ self.rotation.transpose(0, 2, 1)
        return self.scale[:, None, None] * turned + self.translation[:, None]

    def apply_inverse(self, points: np.ndarray) -> np.ndarray:
        """Move (k, m, 3) points back."""
        return ((points - self.translation[:, None]) @ self.rotation) / self.scale[:, None, None]

    def moved(self, moves: np.ndarray) -> _Stack:
        """Move each by a small similarity (rotation vector, translation, logarithm of scale) on its left."""
        from scipy.spatial.transform import Rotation

        scale, turn = np.exp(np.clip(moves[:, 6], -1.0, 1.0)), Rotation.from_rotvec(moves[:, :3]).as_matrix()
        translation = scale[:, None] * np.einsum('kij,kj->ki', turn, self.translation) + moves[:, 3:6]
        return _Stack(scale * self.scale, turn @ self.rotation, translation)


def _stacked(transforms: Sequence[Similarity]) -> _Stack:
    return _Stack(
        np.array([each.scale for each in transforms]),
        np.array([each.rotation for each in transforms]).reshape(-1, 3, 3),
        np.array([each.translation for each in transforms]).reshape(-1, 3),
    )


class _Graph:
    """The edges, (e, 2) nodes and what lies between them, and the sum of squares that they make."""

    def __init__(self, ends: np.ndarray, transforms: _Stack):
        self._ends, self._transforms = ends, transforms
        self._expected = transforms.apply(CORNERS)

    def residuals(self, poses: _Stack) -> np.ndarray:
        """RMS displacement of the corners between the poses and each edge, per unit of the source."""
        return np.sqrt((self._offsets(poses, np.arange(len(self._ends))) ** 2).sum(2).mean(1))

    def _offsets(self, poses: _Stack, edges: np.ndarray) -> np.ndarray:
        world = poses.taken(self._ends[edges, 0]).apply(CORNERS)
        back = poses.taken(self._ends[edges, 1]).apply_inverse(world)
        return (back - self._expected[edges]) / self._transforms.scale[edges, None, None]

    def solved(self, poses: _Stack, weights: np.ndarray, steps: int) -> _Stack:
        """Take Gauss-Newton steps on the weighted squares of the offsets.

        A pose moves by a small similarity on its left; then both ends of an edge have the same derivative up to sign.
        """
        from scipy.sparse import coo_matrix, identity
        from scipy.sparse.linalg import splu

        used = np.flatnonzero(weights > 1e-9)
        if not len(used):
            return poses
        size, ends, root = 7 * len(poses.scale), self._ends[used], np.sqrt(weights[used])[:, None, None]
        rows = np.broadcast_to(np.arange(12 * len(used)).reshape(-1, 12, 1), (len(used), 12, 7)).ravel()
        columns = [np.repeat(7 * ends[:, side, None] + np.arange(7), 12, axis=0).ravel() for side in (0, 1)]
        for _ in range(steps):
            world = poses.taken(ends[:, 0]).apply(CORNERS)
            moves = np.zeros((len(used), 4, 3, 7))
            moves[..., :3] = -_cross(world)
            moves[..., 3:6] = np.eye(3)
            moves[..., 6] = world
            targets = poses.taken(ends[:, 1])
            back = targets.rotation.transpose(0, 2, 1) / (targets.scale * self._transforms.scale[used])[:, None, None]
            blocks = root * (back[:, None] @ moves).reshape(-1, 12, 7)
            values = np.concatenate([blocks.ravel(), -blocks.ravel()])
            places = np.concatenate([rows, rows]), np.concatenate(columns)
            jacobian = coo_matrix((values, places), shape=(12 * len(used), size)).tocsc()
            normal = jacobian.T @ jacobian
            damping = 1e-9 * max(float(normal.diagonal().max()), 1e-12)  # the frame as a whole is free
            right = (root * self._offsets(poses, used).reshape(-1, 12, 1)).ravel()
            step = splu((normal + damping * identity(size)).tocsc()).solve(-jacobian.T @ right).reshape(-1, 7)
            poses = poses.moved(step)
            if np.abs(step).max() < 1e-12:
                break
        return poses


def _weights(residuals: np.ndarray, tolerance: float, mu: float) -> np.ndarray:
    """Return the weights of graduated non-convexity for truncated least squares, Eq. (14) of Yang et al."""
    ratio = np.maximum(residuals / tolerance, 1e-12)
    return np.clip(np.sqrt(mu * (mu + 1.0)) / ratio - mu, 0.0, 1.0)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices of the cross products with (..., 3) vectors."""
    matrices = np.zeros((*vectors.shape, 3))
    for row, column, axis, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
        matrices[..., row, column] = sign * vectors[..., axis]
        matrices[..., column, row] = -sign * vectors[..., axis]
    return matrices


def _components(count: int, ends: np.ndarray) -> np.ndarray:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(ends)), ends.reshape(-1, 2).T), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _checked(count: int, ends: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which edges lie in a cycle of kept ones, and which bridges a rejected edge contradicts.

    Every edge outside a spanning forest draws a random number, which each edge of the forest between its ends takes
    up by exclusive or; what is left at zero no such edge spans.
    """
    from scipy.cluster.hierarchy import DisjointSet

    rng = np.random.default_rng(0)
    sets, parent_edge = DisjointSet(range(count)), np.full(count, -1)
    forest: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    in_forest = np.zeros(len(ends), bool)
    for number in map(int, np.flatnonzero(kept)):
        source, target = ends[number]
        if sets.merge(source, target):
            in_forest[number] = True
            forest[source].append((int(target), number))
            forest[target].append((int(source), number))
    order, parents, seen = [], np.full(count, -1), np.zeros(count, bool)
    for root in range(count):
        stack = [] if seen[root] else [root]
        seen[root] = True
        while stack:
            node = stack.pop()
            order.append(node)
            for other, number in forest[node]:
                if not seen[other]:
                    seen[other] = True
                    parents[other], parent_edge[other] = node, number
                    stack.append(other)
    spanned = {}
    for name, chosen in (('kept', kept & ~in_forest), ('rejected', ~kept)):
        labels = np.zeros(count, np.uint64)
        for number in map(int, np.flatnonzero(chosen)):
            source, target = ends[number]
            if sets.connected(source, target):
                label = rng.integers(1, 2**63, dtype=np.uint64)
                labels[source] ^= label
                labels[target] ^= label
        for node in reversed(order):
            if parents[node] >= 0:
                labels[parents[node]] ^= labels[node]
        spanned[name] = np.zeros(len(ends), bool)
        below = parent_edge >= 0
        spanned[name][parent_edge[below]] = labels[below] != 0
    verified = kept & (~in_forest | spanned['kept'])
    return verified, kept & ~verified & spanned['rejected']
