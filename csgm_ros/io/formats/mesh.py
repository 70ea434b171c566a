"""Meshes: their surface sampled evenly, by the area of the faces (.obj .glb .off read by trimesh)."""

from __future__ import annotations

import re
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile

SAMPLES = 100_000
STL_HEADER, STL_BEGINNING = 84, 2000
STL_FACE = np.dtype([('normal', '<f4', 3), ('corners', '<f4', 9), ('attribute', '<u2')])
STL_VERTEX = re.compile(rb'vertex\s+(\S+)\s+(\S+)\s+(\S+)')


def read(path: Path) -> CloudFile:
    """Sample points, normals and vertex colours of a mesh; a mesh without faces gives its vertices."""
    kind = path.suffix.lower()
    if kind == '.stl':
        corners = _stl(path.read_bytes())
        return _sampled(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    if kind == '.glb':
        with path.open('rb') as file:
            start = file.read(12)
        if len(start) < 12 or int.from_bytes(start[8:12], 'little') > path.stat().st_size:
            raise InputError('ends early; copy or write it again')
    return _trimesh(path, kind)


def _stl(data: bytes) -> np.ndarray:
    """Return the (faces, 3, 3) corners of a binary or text STL file, each face counted."""
    faces = int.from_bytes(data[80:84], 'little')
    whole = STL_HEADER + STL_FACE.itemsize * faces
    if data.lstrip()[:5] == b'solid' and b'facet' in data[:STL_BEGINNING] and len(data) != whole:
        corners = [[float(word) for word in found] for found in STL_VERTEX.findall(data)]
        if not data.rstrip().rpartition(b'\n')[2].lstrip().startswith(b'endsolid'):
            raise InputError('ends early (without endsolid); copy or write it again')
        if len(corners) != 3 * data.count(b'endfacet'):
            raise InputError(f'has {len(corners)} corners for {data.count(b"endfacet")} faces; write it again')
        return np.array(corners, float).reshape(-1, 3, 3)
    if len(data) < STL_HEADER or len(data) < whole:
        there = max(len(data) - STL_HEADER, 0) // STL_FACE.itemsize
        raise InputError(f'ends early ({there} of {faces} faces are there); copy or write it again')
    return np.frombuffer(data, STL_FACE, faces, STL_HEADER)['corners'].reshape(-1, 3, 3).astype(float)


def _trimesh(path: Path, kind: str) -> CloudFile:
    """Read what is more than a list of triangles; what the library prints is no matter of ours."""
    import trimesh

    with redirect_stderr(StringIO()):
        loaded = trimesh.load(path, file_type=kind[1:], process=False, skip_materials=kind == '.obj')
        parts: list[Any] = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if meshes:
        firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        colors = [_vertex_colors(mesh) for mesh in meshes]
        return _sampled(
            np.concatenate([_checked(mesh.vertices) for mesh in meshes]),
            np.concatenate([_within(mesh) + first for mesh, first in zip(meshes, firsts, strict=False)]),
            None if any(each is None for each in colors) else np.concatenate(colors),
        )
    bare: list[np.ndarray] = [_checked(part.vertices) for part in parts if len(getattr(part, 'vertices', ()))]
    if not bare:
        raise InputError('holds neither faces nor points')
    return CloudFile(np.concatenate(bare))


def _checked(vertices: np.ndarray) -> np.ndarray:
    vertices = np.array(vertices, float)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError('holds no points in space')
    return vertices


def _within(mesh) -> np.ndarray:
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise InputError('has faces of vertices that are not there; write it again')
    return faces


def _vertex_colors(mesh) -> np.ndarray | None:
    if mesh.visual.kind != 'vertex' or len(mesh.visual.vertex_colors) != len(mesh.vertices):
        return None
    return np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0


def _sampled(vertices: np.ndarray, faces: np.ndarray, own_colors: np.ndarray | None = None) -> CloudFile:
    """Draw points evenly over the surface, the same at every call."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    reach = np.cumsum(np.nan_to_num(double_area, posinf=0.0))
    if not len(reach) or not 0.0 < reach[-1] < np.inf:
        raise InputError('has no face with an area; write it again')
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(reach, rng.uniform(0.0, reach[-1], SAMPLES), side='right').clip(0, len(faces) - 1)
    root, along = np.sqrt(rng.uniform(size=(SAMPLES, 1))), rng.uniform(size=(SAMPLES, 1))
    weights = np.hstack([1.0 - root, root * (1.0 - along), root * along])
    points = np.einsum('nk,nkd->nd', weights, corners[chosen])
    normals = cross[chosen] / np.maximum(double_area[chosen, None], np.finfo(float).tiny)
    colors = None
    if own_colors is not None:
        colors = np.clip(np.einsum('nk,nkd->nd', weights, own_colors[faces[chosen]]), 0.0, 1.0)
    return CloudFile(points, colors, normals)
