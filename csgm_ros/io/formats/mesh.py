"""Meshes: their surface sampled evenly, by the area of the faces (read by trimesh)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile

SAMPLES = 100_000
STL_HEADER, STL_FACE = 84, 50


def read(path: Path) -> CloudFile:
    """Sample points, normals and vertex colours of a mesh; a mesh without faces gives its vertices."""
    kind = path.suffix.lower()
    _check_complete(path, kind)
    loaded = trimesh.load(path, file_type=kind[1:], process=False, skip_materials=kind == '.obj')
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh() if any(hasattr(each, 'faces') for each in loaded.geometry.values()) else loaded
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces):
        return _sampled(loaded)
    vertices = getattr(loaded, 'vertices', None)
    if isinstance(loaded, trimesh.Scene):
        parts = [np.asarray(each.vertices) for each in loaded.geometry.values() if hasattr(each, 'vertices')]
        vertices = np.concatenate(parts) if parts else None
    if vertices is None or not len(vertices):
        raise InputError('holds neither faces nor points')
    vertices = np.array(vertices, float)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError('holds no points in space')
    return CloudFile(vertices)


def _check_complete(path: Path, kind: str) -> None:
    """Compare the sizes that a binary file declares with its own."""
    size = path.stat().st_size
    with path.open('rb') as file:
        start = file.read(STL_HEADER)
    if kind == '.glb' and len(start) >= 12 and int.from_bytes(start[8:12], 'little') > size:
        raise InputError('ends early; copy or write it again')
    if kind == '.stl':
        if start.lstrip().startswith(b'solid') and b'facet' in path.read_bytes()[:2000]:
            if not path.read_bytes().rstrip().splitlines()[-1].lstrip().startswith(b'endsolid'):
                raise InputError('ends early (without endsolid); copy or write it again')
            return
        faces = int.from_bytes(start[80:84], 'little')
        if len(start) < STL_HEADER or size < STL_HEADER + STL_FACE * faces:
            there = max(size - STL_HEADER, 0) // STL_FACE
            raise InputError(f'ends early ({there} of {faces} faces are there); copy or write it again')


def _sampled(mesh) -> CloudFile:
    """Draw points evenly over the surface, the same at every call."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError('has faces of vertices that are not there; write it again')
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    reach = np.cumsum(np.nan_to_num(double_area, posinf=0.0))
    if not reach[-1] > 0.0:
        raise InputError('has no face with an area; write it again')
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(reach, rng.uniform(0.0, reach[-1], SAMPLES), side='right').clip(0, len(faces) - 1)
    root, along = np.sqrt(rng.uniform(size=(SAMPLES, 1))), rng.uniform(size=(SAMPLES, 1))
    weights = np.hstack([1.0 - root, root * (1.0 - along), root * along])
    points = np.einsum('nk,nkd->nd', weights, corners[chosen])
    normals = cross[chosen] / np.maximum(double_area[chosen, None], np.finfo(float).tiny)
    colors = None
    if mesh.visual.kind == 'vertex' and len(mesh.visual.vertex_colors) == len(vertices):
        own = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
        colors = np.clip(np.einsum('nk,nkd->nd', weights, own[faces[chosen]]), 0.0, 1.0)
    return CloudFile(points, colors, normals)
