"""Two clouds as verification sees them, and all that was measured on them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np

from csgm_ros.cloud.agreement import Comparison
from csgm_ros.cloud.witnesses import Witnesses, robust_radius, witnesses, working_cell
from csgm_ros.config import Config
from csgm_ros.progress import Look, unhurried
from csgm_ros.types import NormalizedPair, Similarity, Surface, Verdict
from csgm_ros.verification.decide import Units, decide, within_bounds
from csgm_ros.verification.evidence import Evidence, measure
from csgm_ros.verification.findings import (
    Findings,
    Polish,
    Probes,
    Refine,
    apart,
    centred,
    compared,
    exchanged,
    polished,
    probe,
    probed,
)
from csgm_ros.verification.free_space import seen_through
from csgm_ros.verification.surfaces import normal_angle, surface

SAME_SCALE = 0.35  # |log ratio| up to which two scales share a comparison
AS_GOOD = 0.75  # of the evidence of a start, with which the end that all starts lead to is believed: the best is chance
THERE = 0.002  # cells
MOST_COMPARED = 12  # finalists that a winner is compared with

Viewpoints = tuple[np.ndarray | None, np.ndarray | None]


class View:
    """The pair at one smoothing, and all that was measured on it so far; belongs to one registration.

    Parameters
    ----------
    refine : callable
        See :data:`csgm_ros.verification.findings.Refine`.
    viewpoints : pair of (3,) ndarray or None
        Where the sensors stood, in each cloud's own frame and unit, where known.
    smoothed : bool, optional
        The clouds have been smoothed.
    look : callable, optional
        Asked between the steps of a judgement.

    Attributes
    ----------
    pair : NormalizedPair
    measured : list of Evidence
        What the verdict compares a transform with, over all attempts at this smoothing.
    refined : dict of (str, bytes) to Evidence
        What a refinement, by its name, made of a matrix.
    rivals : list of (Similarity, float)
        What the last verdict compared with, and how well each fitted beside the winner; best first.
    """

    def __init__(
        self,
        pair: NormalizedPair,
        config: Config,
        rng: np.random.Generator,
        refine: Refine,
        viewpoints: Viewpoints = (None, None),
        *,
        smoothed: bool = False,
        look: Look = unhurried,
    ):
        self.pair = pair
        self.measured: list[Evidence] = []
        self.refined: dict[tuple[str, bytes], Evidence] = {}
        self.rivals: list[tuple[Similarity, float]] = []
        self._config, self._rng, self._refine = config, rng, refine
        self._viewpoints, self._smoothed, self._look = viewpoints, smoothed, look
        self._seen: dict[tuple[int, float, float], Witnesses] = {}
        self._comparisons: dict[int, Comparison] = {}
        self._probes: dict[bytes, Probes | None] = {}
        self._polished: dict[tuple[int, bool, bytes], np.ndarray] = {}

    @cached_property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Source and target, finely sampled."""
        made = []
        for points in self.pair.normalized:
            made.append(surface(points, self._config, self._rng))
            self._look()
        return made[0], made[1]

    @cached_property
    def max_angle(self) -> float:
        """Degrees that the normals of two points in one place may differ by."""
        if self._smoothed:
            # smoothing makes the normals of neighbours agree more than they can with the other cloud's
            return self._config.verification.max_normal_angle
        return normal_angle(*self.surfaces, self._config)

    def measure(self, transform: Similarity) -> Evidence:
        """Return the evidence for one transform between the normalised clouds."""
        return measure(transform, *self.surfaces, self._config.verification.inlier_distance, self.max_angle)

    def score(self, transform: Similarity) -> float:
        """Return how far the clouds agree under a transform at the length of their structure."""
        comparison, scale = self.comparison(transform.scale)
        return comparison.agreement(_reduced(transform, scale)).evidence

    def polished(self, transform: Similarity) -> Similarity:
        """Return a transform after an ICP of all witnesses, to convergence: of one place, the same whatever led there.

        Or as it was, where they do not hold it, or it was there already: what is exact stays exact.
        """
        comparison, scale = self.comparison(transform.scale)
        start = _reduced(transform, scale)
        end = self._polish(comparison)(start)
        if self._config.scale.estimate_scale:
            end = centred(comparison, end, self._looking)
        held = comparison.agreement(end).evidence >= AS_GOOD * comparison.agreement(start).evidence
        if not held or apart(comparison, start, end) < THERE:
            return transform
        return Similarity.from_matrix(end @ np.diag([scale, scale, scale, 1.0]))

    def judge(self, best: Evidence) -> Verdict:
        """Return the verdict on a transform, all that was measured before competing with it."""
        others = sorted(self.measured, key=lambda evidence: -evidence.score)[:MOST_COMPARED]
        transforms = [other.transform for other in others]
        findings = self.compared(best.transform, transforms)
        self._look()
        if self._decided(best, findings).accepted:
            findings = self.probed(best.transform, findings)
        self.rivals = self._unreduced(findings, best.transform.scale)
        verdict = self._decided(best, findings)
        return replace(verdict, inlier_rmse=verdict.inlier_rmse * self._units(best).length)

    def compared(self, transform: Similarity, others: Iterable[Similarity]) -> Findings:
        """Return what other transforms and the viewpoints say about one between the normalised clouds."""
        comparison, scale = self.comparison(transform.scale)
        self._look()
        starts = (_reduced(other, scale) for other in others)
        findings = compared(comparison, _reduced(transform, scale), starts, self._polish(comparison))
        return replace(findings, seen_through=self._seen_through(transform))

    def probed(self, transform: Similarity, findings: Findings) -> Findings:
        """Return the findings with those of probes added; a winner is probed once."""
        comparison, scale = self.comparison(transform.scale)
        winner, key = _reduced(transform, scale), transform.matrix.tobytes()
        if key not in self._probes:
            scaled = self._config.scale.estimate_scale
            self._probes[key] = probe(comparison, winner, findings.agreement, self._looking, estimate_scale=scaled)
        return probed(comparison, winner, findings, self._probes[key], self._polish(comparison))

    def _polish(self, comparison: Comparison) -> Polish:
        """Return what polishes a transform, once."""

        def polish(start: np.ndarray, *, scaled: bool = True) -> np.ndarray:
            scaled = scaled and self._config.scale.estimate_scale
            key = id(comparison), scaled, start.tobytes()
            if key not in self._polished:
                self._polished[key] = polished(comparison, start[None], self._looking, estimate_scale=scaled)[0]
            return self._polished[key]

        return polish

    def _looking(self, *asked, **options) -> np.ndarray:
        """Refine, once there was a look at the clock."""
        self._look()
        return self._refine(*asked, **options)

    def _unreduced(self, findings: Findings, scale: float) -> list[tuple[Similarity, float]]:
        back = np.diag([*3 * [self.comparison(scale)[1]], 1.0])
        rivals = sorted(findings.rivals, key=lambda rival: -rival.ratio)
        return [(Similarity.from_matrix(r.transform @ back), r.ratio) for r in rivals if r.transform is not None]

    def _decided(self, best: Evidence, findings: Findings) -> Verdict:
        """Return the verdict in terms of who asked."""
        config, scale, units = self._config, self._config.scale, self._units(best)
        if self.pair.exchanged:
            findings = exchanged(findings, best.transform.matrix)
            best = replace(best, fitness_source=best.fitness_target, fitness_target=best.fitness_source)
            scale = scale.exchanged()
        verdict = decide(best, findings, config.verification, units, estimate_scale=scale.estimate_scale)
        return within_bounds(verdict, units.scale, scale)

    def _units(self, best: Evidence) -> Units:
        """Return the units of who asked."""
        scale, length = self.pair.in_own_units(best.transform).scale, 1.0 / self.pair.normalizations[1].scale
        return Units(length / scale, 1.0 / scale) if self.pair.exchanged else Units(length, scale)

    def comparison(self, scale: float) -> tuple[Comparison, float]:
        """Return the clouds at the length of their structure, the source enlarged, and by how much."""
        if not self._config.scale.estimate_scale:
            step, used = 0, 1.0
        else:
            step = round(np.log(scale) / SAME_SCALE)
            used = float(np.exp(step * SAME_SCALE))
        if step not in self._comparisons:
            cells, radii = self._lengths
            source = self._witnesses(0, min(cells[0], cells[1] / used), min(radii[0], radii[1] / used))
            target = self._witnesses(1, min(cells[0] * used, cells[1]), min(radii[0] * used, radii[1]))
            self._comparisons[step] = Comparison(source.resized(used), target, target.cell)
        return self._comparisons[step], used

    def _witnesses(self, side: int, cell: float, radius: float) -> Witnesses:
        """Return a cloud at a cell, as far as a radius; the smaller one's are the same at many scales."""
        if (side, cell, radius) not in self._seen:
            self._look()
            points, neighbors = self.pair.normalized[side], self._config.preprocess.normal_neighbors
            # each draws as if it were the only one: which of two is called the source must not matter
            drawn = np.random.default_rng(0)
            self._seen[side, cell, radius] = witnesses(points, cell, 2.0 * radius, drawn, neighbors)
        return self._seen[side, cell, radius]

    @cached_property
    def _lengths(self) -> tuple[list[float], list[float]]:
        """The working cells and the radii of source and target."""
        self._look()
        clouds = self.pair.normalized
        return [working_cell(points) for points in clouds], [robust_radius(points) for points in clouds]

    def _seen_through(self, transform: Similarity) -> float:
        """Return the larger share of either cloud that the other's sensor, where its place is known, looked through."""
        source, target = self.pair.clouds
        own = self.pair.in_own_units(transform)
        shares = []
        if self._viewpoints[0] is not None:
            shares.append(seen_through(own.inverse().apply(target), source, self._viewpoints[0]))
        if self._viewpoints[1] is not None:
            shares.append(seen_through(own.apply(source), target, self._viewpoints[1]))
        return max((share for share in shares if share is not None), default=0.0)


def _reduced(transform: Similarity, scale: float) -> np.ndarray:
    """Return the matrix of a transform for a source that was enlarged by a scale."""
    return transform.matrix @ np.diag([1.0 / scale, 1.0 / scale, 1.0 / scale, 1.0])
