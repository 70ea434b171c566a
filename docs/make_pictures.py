"""Make the pictures of the method's page from a real pair: `python docs/make_pictures.py PAIR`.

PAIR is a folder with source.ply, target.ply and gt.json. The published ones are of the pair `bin_shelf` of the APC
vision toolbox (BSD-style licence), photos against a depth camera, with the scale given.
"""

import argparse
import json
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot
from matplotlib.collections import LineCollection
from PIL import Image

import csgm_ros
from csgm_ros.config import profile, replaced
from csgm_ros.io.files import CloudFile, read_cloud
from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT
from csgm_ros.types import Similarity
from csgm_ros.visual.pictures import draw, palette, turned
from csgm_ros.visual.scene import COLORS
from csgm_ros.visual.slices import principal_axes, slices

OUT = Path(__file__).parent / 'pictures'
SIZE = (330, 430)


def main():
    """Register the pair once and draw each step of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('pair', type=Path)
    pair = parser.parse_args().pair
    matplotlib.use('Agg')
    truth = Similarity.from_matrix(np.array(json.loads((pair / 'gt.json').read_text())['T_target_source']))
    source, target = (read_cloud(pair / f'{name}.ply') for name in ('source', 'target'))
    source = CloudFile(source.points * truth.scale, source.colors)
    config = replaced(profile(), {'scale.estimate_scale': False})
    result = csgm_ros.register(source.points, target.points, config, details=True)
    print(f'{"accepted" if result.accepted else "rejected"}: {result.reason}')
    off = result.transform.apply(source.points) - _rigid(truth)(source.points)
    print(f'{np.linalg.norm(off, axis=1).mean():.3f} m off')
    graphs = result.source_graph, result.target_graph
    view = _view(target.points)
    structures = result.details.structures
    sides = [
        Similarity(1.0, result.transform.rotation, np.zeros(3)) @ structures[0].normalization.inverse(),
        structures[1].normalization.inverse(),
    ]
    shown = [side.apply(each.surface.points) for side, each in zip(sides, structures, strict=True)]
    cut = [np.where(each.labels[:, None] < 0, 0.85, palette(COLORS)[each.labels % COLORS]) for each in structures]
    save(
        '1_clouds',
        [('source, photos', draw([source], view, SIZE)), ('target, depth camera', draw([target], view, SIZE))],
    )
    save(
        '2_supervoxels',
        [
            (f'{name}: {len(graph.nodes)} supervoxels', dots(points, colors, view))
            for name, points, colors, graph in zip(('source', 'target'), shown, cut, graphs, strict=True)
        ],
    )
    laid_out = beside(shown, graphs, view, result)
    with_graphs(*laid_out, graphs)
    affinities(result.details.graphs)
    with_matches(laid_out[1], graphs, result)
    hypotheses(source, target, result, view)
    moved = result.transform.apply(source.points)
    save('6_slices', slices(moved, target.points, SIZE))


def _rigid(truth):
    return Similarity(1.0, truth.rotation, truth.translation).apply


def _view(points):
    axes = principal_axes(points - np.median(points, axis=0))
    axes[2] *= -np.sign(axes[2] @ np.median(points, axis=0)) or 1.0
    return turned(np.array([axes[1], np.cross(-axes[2], axes[1]), -axes[2]]), 20, 15)


def dots(points, colors, view):
    """Draw few points as large ones."""
    spread = np.repeat(points, 9, axis=0)
    step = 0.004 * np.ptp(points @ view.T, axis=0).max()
    offsets = np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * step
    return draw(
        [CloudFile(spread + np.tile(offsets @ view, (len(points), 1)), np.repeat(colors, 9, axis=0))], view, SIZE
    )


def beside(shown, graphs, view, result):
    """Lay voxels and nodes of both clouds out beside each other, as seen from one side: two lists of (n, 2)."""
    nodes = [Similarity(1.0, result.transform.rotation, np.zeros(3)).apply(graphs[0].nodes), graphs[1].nodes]
    clouds = [points @ view.T for points in shown]
    width = 1.1 * max(np.ptp(cloud[:, 0]) for cloud in clouds)
    at = [np.array([width * k, 0.0]) - np.median(cloud[:, :2], axis=0) for k, cloud in enumerate(clouds)]
    return (
        [cloud[:, :2] + shift for cloud, shift in zip(clouds, at, strict=True)],
        [points @ view[:2].T + shift for points, shift in zip(nodes, at, strict=True)],
    )


def plain(axis, title):
    """Take what a picture does not need off an axis."""
    axis.set_title(title, fontsize=9)
    axis.invert_yaxis()
    axis.set_aspect('equal')
    axis.set_axis_off()


def edges_of(axis, points, graph, tint, alpha):
    """Draw nodes and edges."""
    axis.add_collection(LineCollection(points[np.sort(graph.edges, axis=1)], colors=[(*tint, alpha)], lw=0.8))
    axis.scatter(*points.T, s=9, color=tint, zorder=2)


def with_graphs(clouds, nodes, graphs):
    """Draw both graphs over their voxels."""
    figure, axis = pyplot.subplots(figsize=(11, 4.2), dpi=80, layout='constrained')
    for cloud, points, graph, tint in zip(clouds, nodes, graphs, (SOURCE_TINT, TARGET_TINT), strict=True):
        axis.scatter(*cloud.T, s=4, color='#dddddd', lw=0)
        edges_of(axis, points, graph, tint, 0.6)
    plain(axis, ', '.join(f'{len(graph.nodes)} nodes and {len(graph.edges) // 2} edges' for graph in graphs))
    written(figure, '3_graphs')


def with_matches(nodes, graphs, result):
    """Draw the matches between both graphs, before and after the transform is known."""
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 3.2), dpi=80, layout='constrained')
    unguided = result.unguided_matches, result.unguided_inliers
    for axis, title, (pairs, inliers) in zip(
        axes,
        (
            f'matched without the transform: {unguided[1].sum()} of {len(unguided[0])} agree',
            f'matched under the transform: {len(result.matches)} of {len(graphs[0].nodes)} nodes',
        ),
        (unguided, (result.matches, result.match_inliers)),
        strict=True,
    ):
        for points, graph, tint in zip(nodes, graphs, (SOURCE_TINT, TARGET_TINT), strict=True):
            edges_of(axis, points, graph, tint, 0.2)
        for (i, a), agrees in zip(pairs, inliers, strict=True):
            axis.plot(*np.array([nodes[0][i], nodes[1][a]]).T, lw=0.7, color='#2a2' if agrees else '#c33', alpha=0.7)
        plain(axis, title)
    written(figure, '4_matches')


def affinities(graphs):
    """Draw K_p, K_q and J along the path."""
    figure, axes = pyplot.subplots(1, 3, figsize=(11, 3.2), dpi=80, layout='constrained')
    for axis, (title, values) in zip(
        axes, (('$K_p$, nodes', graphs.node_affinity), ('$K_q$, edges', graphs.edge_affinity)), strict=False
    ):
        axis.imshow(values, aspect='auto', cmap='viridis', interpolation='antialiased')
        axis.set_title(title, fontsize=9)
        axis.set_xlabel('target', fontsize=8)
        axis.set_ylabel('source', fontsize=8)
    axes[2].plot(*graphs.matching.path.T, marker='.')
    axes[2].set_title(r'$J$ along the path', fontsize=9)
    axes[2].set_xlabel(r'$\alpha$', fontsize=8)
    axes[2].grid(alpha=0.3)
    written(figure, '4_matching')


def hypotheses(source, target, result, view):
    """Draw the answer and the best that competed with it."""
    tinted = CloudFile(target.points, np.tile(TARGET_TINT, (len(target.points), 1)))
    panels = []
    for rank, each in enumerate(result.details.hypotheses[:3]):
        transform = result.transform if rank == 0 else each.transform
        moved = CloudFile(transform.apply(source.points), np.tile(SOURCE_TINT, (len(source.points), 1)))
        title = 'the answer' if rank == 0 else f'competing hypothesis {rank}'
        panels.append((f'{title}, score {each.score:.2f}', draw([tinted, moved], view, SIZE)))
    save('5_hypotheses', panels)


def save(name, panels):
    """Write pictures beside each other."""
    figure, axes = pyplot.subplots(1, len(panels), figsize=(5.5 * len(panels) if len(panels) < 3 else 11, 3.6), dpi=80)
    for axis, (title, pixels) in zip(axes, panels, strict=True):
        axis.imshow(pixels)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    figure.subplots_adjust(left=0.01, right=0.99, top=0.92, bottom=0.01, wspace=0.03)
    written(figure, name)


def written(figure, name):
    """Write a figure with few colours: it is small then."""
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    pyplot.close(figure)
    OUT.mkdir(exist_ok=True)
    Image.fromarray(pixels).quantize(64, dither=Image.Dither.NONE).save(OUT / f'{name}.png', optimize=True)


if __name__ == '__main__':
    main()
