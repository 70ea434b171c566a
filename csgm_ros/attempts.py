"""The retry schedule: what is tried, in which order, until something is accepted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from csgm_ros.cloud.surface_variation import even, surface_variation
from csgm_ros.config import Config
from csgm_ros.types import NormalizedPair, RegistrationResult

MAX_SMOOTHING = 0.05  # of a cloud's points: averaged over more, little of its shape is left


@dataclass(frozen=True)
class Attempt:
    """How the clouds are looked at.

    Attributes
    ----------
    smoothing : int
        Neighbours that noise is averaged over; 0 takes the clouds as they are.
    relative : float
        Lengths in the source relative to those in the target.
    """

    smoothing: int = 0
    relative: float = 1.0


def schedule(pair: NormalizedPair, config: Config) -> Iterator[Attempt]:
    """Yield the clouds as they are; while nothing is accepted, smoothed if noisy, then at other relative lengths.

    A later attempt costs as much as the first, so it is only asked for, and the noise only measured, when needed.
    """
    yield Attempt()
    if config.hypotheses.method == 'ransac':
        return
    if _surface_variation(pair) > config.preprocess.max_surface_variation:
        most = MAX_SMOOTHING * min(map(len, pair.clouds))
        yield from (Attempt(smoothing=count) for count in config.preprocess.smoothing if count <= most)
    if config.scale.estimate_scale:
        relatives = config.hypotheses.relative_scales
        yield from (Attempt(relative=relative) for relative in relatives if relative != 1.0)


def _surface_variation(pair: NormalizedPair) -> float:
    sides = zip(pair.clouds, pair.normalizations, strict=True)
    return max(surface_variation(even(cloud, 1.0 / unit.scale)) for cloud, unit in sides)


class Ranked(NamedTuple):
    """What an attempt found.

    Attributes
    ----------
    result : RegistrationResult
    likelihood : float
        How far the clouds as they are agree there, at two lengths of their structure.
    """

    result: RegistrationResult
    likelihood: float


def best_of(found: Iterable[Ranked]) -> RegistrationResult:
    """Return the accepted result, else the likeliest one."""
    return max(found, key=lambda one: (one.result.accepted, one.likelihood)).result
