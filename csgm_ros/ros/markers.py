"""The two structure graphs and their matches as RViz markers, in the target's frame."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from csgm_ros.types import RegistrationResult

COLORS = {
    'target': ColorRGBA(r=0.47, g=0.59, b=0.75, a=1.0),
    'source': ColorRGBA(r=0.94, g=0.59, b=0.2, a=1.0),
    'inlier': ColorRGBA(r=0.2, g=0.8, b=0.3, a=1.0),
    'outlier': ColorRGBA(r=0.85, g=0.2, b=0.2, a=0.4),
}


def graph_markers(result: RegistrationResult, head: Header) -> MarkerArray:
    """Return nodes (spheres), edges and matches (lines; green where they agree with the transform).

    Sizes follow the target graph's extent, so that a desk and a street are equally readable.
    """
    markers = [Marker(header=head, action=Marker.DELETEALL)]
    if result.source_graph is None or result.target_graph is None:
        return MarkerArray(markers=markers)
    target, source = result.target_graph.nodes, result.transform.apply(result.source_graph.nodes)
    size = 0.01 * float(np.ptp(target, axis=0).max())
    for name, nodes, edges in (
        ('target', target, result.target_graph.edges),
        ('source', source, result.source_graph.edges),
    ):
        markers.append(marker(head, f'{name}_nodes', Marker.SPHERE_LIST, 1.5 * size, COLORS[name], nodes))
        lines = nodes[edges].reshape(-1, 3)
        markers.append(marker(head, f'{name}_edges', Marker.LINE_LIST, 0.2 * size, COLORS[name], lines))
    ends = np.stack([source[result.matches[:, 0]], target[result.matches[:, 1]]], axis=1)
    for name, chosen in (('inlier', result.match_inliers), ('outlier', ~result.match_inliers)):
        lines = ends[chosen].reshape(-1, 3)
        markers.append(marker(head, f'{name}_matches', Marker.LINE_LIST, 0.4 * size, COLORS[name], lines))
    return MarkerArray(markers=markers)


def marker(head: Header, namespace: str, kind: int, size: float, color: ColorRGBA, points: np.ndarray) -> Marker:
    """Return one list marker of (N, 3) points."""
    made = Marker(header=head, ns=namespace, id=0, type=kind, action=Marker.ADD, color=color)
    made.pose.orientation.w = 1.0
    made.scale.x = made.scale.y = made.scale.z = max(size, 1e-6)
    made.points = [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
    return made
