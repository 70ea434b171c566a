"""A result for people and for programs: text, JSON and pictures."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from csgm_ros.config import flatten
from csgm_ros.io.atomic import write_text
from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.io.transforms import matrix_text
from csgm_ros.types import RegistrationResult, Similarity, Undetermined, rotation_angle

TARGET_TINT = (0.12, 0.47, 0.71)
SOURCE_TINT = (0.95, 0.55, 0.15)


class ProgressBar:
    """Shows the running stage on a terminal's stderr; silent anywhere else. A context manager to call."""

    def __init__(self, stream=None):
        self._stream = stream or sys.stderr
        self._bar = None

    def __enter__(self) -> ProgressBar:
        if self._stream.isatty():
            from tqdm import tqdm

            shape = '{desc:<20} {percentage:3.0f}% |{bar:26}| {elapsed}<{remaining}'
            self._bar = tqdm(total=1.0, bar_format=shape, ncols=72, file=self._stream, leave=False)
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.close()

    def __call__(self, stage: str, fraction: float) -> None:
        """Note that ``stage`` runs and that ``fraction`` of the whole is done."""
        if self._bar is not None:
            self._bar.set_description_str(stage.replace('_', ' '), refresh=False)
            self._bar.n = fraction
            self._bar.refresh()


def as_mapping(result: RegistrationResult) -> dict[str, Any]:
    """Return a result as plain values: what ``--json`` writes."""
    return {
        'T_target_source': result.T_target_source.tolist(),
        'scale': float(result.scale),
        'accepted': bool(result.accepted),
        'reason': result.reason,
        'fitness_source': float(result.fitness_source),
        'fitness_target': float(result.fitness_target),
        'inlier_rmse': _finite(result.verdict.inlier_rmse),
        'margin': _finite(result.verdict.margin),
        'confidence': float(result.confidence),
        'undetermined': _undetermined(result.undetermined),
        'seconds': result.seconds,
        'timings': result.timings,
        'seed': result.seed,
        'config': flatten(result.config),
    }


def _undetermined(open_: Undetermined | None) -> dict[str, Any] | None:
    if open_ is None:
        return None
    return {'kind': open_.kind, 'direction': open_.direction.tolist(), 'low': open_.low, 'high': open_.high}


def write_json(path: str | Path, result: RegistrationResult, inputs: dict[str, str] | None = None) -> None:
    """Write :func:`as_mapping` to a file, with where the clouds came from as `inputs`.

    Raises
    ------
    InputError
        Where the file cannot be written, or the disk is full.
    """
    write_text(path, json.dumps(as_mapping(result) | {'inputs': inputs or {}}, indent=2, allow_nan=False) + '\n')


def summary(result: RegistrationResult) -> str:
    """Return a result as the few lines that the command line prints."""
    fitness = f'{result.fitness_source:.0%} of the source and {result.fitness_target:.0%} of the target overlap'
    return '\n'.join(
        [
            f'{"accepted" if result.accepted else "rejected"}: {result.reason}',
            f'{fitness}, inliers {result.verdict.inlier_rmse:.4g} apart (RMS); {result.seconds:.1f} s',
            f'scale {result.scale:.6g}; T_target_source, x_target = s R x_source + t:',
            matrix_text(result.T_target_source),
        ]
    )


def errors(estimate: Similarity, truth: Similarity, source: np.ndarray) -> dict[str, float]:
    """Measure an estimate against the known truth.

    Parameters
    ----------
    estimate, truth : Similarity
        From source to target.
    source : (N, 3) ndarray
        Points whose displacement counts.

    Returns
    -------
    dict
        `rotation_deg`, `scale_percent`, and `mean_displacement` in target units.
    """
    return {
        'rotation_deg': math.degrees(rotation_angle(estimate.rotation.T @ truth.rotation)),
        'scale_percent': 100 * abs(estimate.scale / truth.scale - 1),
        'mean_displacement': float(np.linalg.norm(estimate.apply(source) - truth.apply(source), axis=1).mean()),
    }


def moved(cloud: CloudFile, transform: Similarity) -> CloudFile:
    """Return a cloud in the frame of the target, its normals turned with it."""
    normals = None if cloud.normals is None else cloud.normals @ transform.rotation.T
    return CloudFile(transform.apply(cloud.points), cloud.colors, normals)


def fused(source: CloudFile, target: CloudFile, transform: Similarity) -> CloudFile:
    """Return the target and the moved source in one cloud.

    Each keeps its own colours where it has them; else the target is blue and the source is orange. Where only one has
    normals, those of the other are zero.
    """
    source = moved(source, transform)
    parts = [
        cloud.colors if cloud.colors is not None else np.tile(tint, (len(cloud.points), 1))
        for cloud, tint in ((target, TARGET_TINT), (source, SOURCE_TINT))
    ]
    normals = None
    if target.normals is not None or source.normals is not None:
        normals = np.concatenate(
            [np.zeros_like(each.points) if each.normals is None else each.normals for each in (target, source)]
        )
    return CloudFile(np.concatenate([target.points, source.points]), np.concatenate(parts), normals, target.origin)


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return float(value) if math.isfinite(value) else None
