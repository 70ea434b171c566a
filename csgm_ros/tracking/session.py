"""A session: frames in, poses in the map out, with what is known said and nothing else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import numpy as np

from csgm_ros.config import Config, profile
from csgm_ros.errors import CsgmError, InputError
from csgm_ros.tracking import frames, localization, maps
from csgm_ros.tracking.alignment import Fit, align, align_through
from csgm_ros.tracking.evidence import Evidence, weigh
from csgm_ros.tracking.frames import Frame
from csgm_ros.tracking.localization import scale_of, scaling
from csgm_ros.tracking.maps import PreparedMap
from csgm_ros.tracking.odometry import Odometry, between
from csgm_ros.tracking.recheck import recheck
from csgm_ros.tracking.scale import Scale
from csgm_ros.tracking.search import Candidates, Found, Query, expected, search
from csgm_ros.tracking.settling import LEAST_FRAMES
from csgm_ros.tracking.views import seen
from csgm_ros.types import Estimate, Prior

LOST, LOCALIZING, TRACKING = 'lost', 'localizing', 'tracking'
MIN_POINTS = 200
SAMPLES = 2500
SOON, EVERY = 0.3, 2.0  # seconds of new frames after which a place that was found is checked first, and then again
ASTRAY = 0.3, 25.0, 0.05  # sigma of a sensor about a place that may be a little off: metres, degrees, relative scale
LATELY, BETWEEN = 6, 2  # frames that are laid on the map, and every which one they are
GAIN = 0.5  # of a correction of the map's place relative to the odometry
WORSE, ELSEWHERE = 2.5, 2.0  # times as much as where it was tracked may disagree: where a frame confirms, a check moves
FOUND = 1.25, 1.5  # and where a search finds, by fewer than LEAST_FRAMES and by more: most wrong places disagree more
SIMILAR = 0.6  # of what was tracked: closeness at which a place is as good
REACHES = 1.5, np.inf  # of the searches, one after the other: what one does not find, the next may
FRESH = 0.25  # of the first seconds: new frames that are worth another look
FLOOR = 0.02, 0.02  # systematic error of a map that is not quite a similarity of the scene: metres, radians
CORRELATION = 30.0  # neighbouring points share their error: this many count as one


class Job(NamedTuple):
    """A search under way: for which stretch of odometry, up to when, where the sensor was then, and what it found.

    ``prior`` is where it was expected.
    """

    segment: int
    stamp: float
    sensor: np.ndarray
    prior: Prior | None
    future: Future


class Session:
    """Follows a depth sensor through a map of unknown scale.

    Parameters
    ----------
    map_points : (N, 3) ndarray or PreparedMap
        The map in any unit and pose.
    config : Config, optional
    seed : int, optional
        Same frames, configuration and seed: same bits, where no executor decides when a search ends.
    executor : concurrent.futures.Executor, optional
        Where place and scale are searched for while frames keep coming; a pool of one thread will do. Without one
        :meth:`add` does so itself, and takes seconds while lost.
    """

    def __init__(
        self,
        map_points: np.ndarray | PreparedMap,
        config: Config | None = None,
        *,
        seed: int = 0,
        executor: Executor | None = None,
    ):
        self.config = config or profile()
        self._map = map_points if isinstance(map_points, PreparedMap) else maps.prepare_map(map_points)
        self._seed, self._executor = seed, executor
        self._rng = np.random.default_rng(seed)
        self._voxel = 0.0  # of the frames, metres; 0 before the first frame
        self._odometry: Any = None  # Odometry from the first frame of a segment on
        self._segment = 0  # number of the present stretch of odometry without a break
        self._recent: list[tuple[float, Frame, np.ndarray]] = []
        self._stamp = self._heard = self._supported = -np.inf
        self._state, self._reason = LOST, 'no frame yet'
        self._place: Any = None  # once localized, T_map_odometry of this segment
        self._close = np.inf  # closeness there of what it was found by
        self._confirmed = 0
        self._scale = Scale()
        self._found: Any = None  # Job that led to the place
        self._check: tuple[int, Future] | None = None  # under way, for which stretch of odometry
        self._unchecked, self._checked = True, -np.inf  # the place, and stamp of the newest frame that was asked
        self._level: Any = None  # Level of the map, once localized
        self._prior: Prior | None = None
        self._job: Job | None = None
        self._covariance: np.ndarray | None = None
        self._typical = np.zeros(3)  # closeness, share and agreement of tracked frames
        self._candidates: Candidates | None = None  # of this segment
        self._searches = 0  # without success
        self._looked = -np.inf  # stamp of the newest frame that was searched for
        self._closed = threading.Event()

    @property
    def state(self) -> str:
        """``lost``, ``localizing`` or ``tracking``."""
        return self._state

    @property
    def scale(self) -> float:
        """Map units a metre; NaN while unknown."""
        return self._scale.value

    def close(self) -> None:
        """Give up a search that an executor still runs; the session takes frames no more."""
        self._closed.set()

    def relocalize(self, prior: Prior | None = None) -> None:
        """Forget the place and search for it again, near ``prior`` (sensor to map) first where one is given."""
        self._lose(LOCALIZING, 'asked to localise again')
        self._prior = prior

    def add(self, points: np.ndarray, stamp: float, *, odometry: np.ndarray | None = None) -> Estimate:
        """Take one frame and say where the sensor is.

        Parameters
        ----------
        points : (N, 3) ndarray
            Metres, in the sensor's frame, whose origin is the viewpoint; rows that are not finite are ignored.
        stamp : float
            Seconds.
        odometry : (4, 4) ndarray, optional
            Rigid pose of the sensor in a frame that drifts slowly, metres.

        Raises
        ------
        InputError
            For what is no frame; the session goes on with the next one.
        """
        started = time.perf_counter()
        points = _frame_points(points)
        if not np.isfinite(stamp):
            raise InputError(f'stamp: {stamp}; give the seconds of the frame')
        evidence = self._take(points, float(stamp), odometry)
        pose = None
        if self._state == TRACKING and evidence is not None:
            pose = self._place @ self._odometry.matrix
        return Estimate(
            float(stamp),
            self._state,
            self._reason,
            pose,
            self._scale.value,
            self._scale.sigma,
            None if pose is None else self._covariance,
            evidence.share if evidence else 0.0,
            evidence.agreement if evidence else 0.0,
            time.perf_counter() - started,
        )

    def _take(self, points: np.ndarray, stamp: float, odometry: np.ndarray | None) -> Evidence | None:
        self._learn_more()
        self._collect()
        part = self.config.tracking
        if stamp < self._stamp:
            self._break('the stamps went back')
            self._heard = self._supported = -np.inf
        self._stamp = stamp
        if len(points) < MIN_POINTS:
            self._doubt(f'the frame has {len(points)} points')
            return None
        if not self._voxel:
            self._voxel = frames.resolution(points, part.resolution)
        if self._odometry is not None and stamp - self._heard > part.max_gap:
            self._break(f'no usable frame for {stamp - self._heard:.1f} s')
        self._heard = stamp
        frame = frames.prepared(points, self._voxel)
        self._move(frame, stamp, odometry)
        evidence = self._judge(frame)
        if self._state == TRACKING:
            self._recheck()
        else:
            self._seek(stamp)
        return evidence

    def _move(self, frame: Frame, stamp: float, odometry: np.ndarray | None) -> None:
        """Carry the odometry on by a frame, or begin a new stretch of it."""
        if self._odometry is not None and not self._odometry.add(frame, stamp, pose=odometry):
            self._break('the frame does not fit the last ones')
        if self._odometry is None:
            self._odometry = Odometry(self._voxel, np.random.default_rng(self._seed))
            self._odometry.add(frame, stamp, pose=odometry)
        self._recent.append((stamp, frame, self._odometry.matrix.copy()))
        oldest = stamp - self.config.tracking.most_seconds
        self._recent = [item for item in self._recent if item[0] >= oldest]

    def _judge(self, frame: Frame) -> Evidence | None:
        """Refine the place by the newest frame and let the evidence decide about the state."""
        if self._place is None:
            return None
        part = self.config.tracking
        before = self._place, self._scale
        self._refine(frame, self._odometry.matrix)
        evidence = self._evidence(frame, self._odometry.matrix)
        if evidence.share < part.min_on_map:
            self._place, self._scale = before  # a frame beside the map cannot tell where it is
        if not self._confirms(evidence):
            self._confirmed = 0
            text = f'{evidence.share:.0%} of the frame on the map, {evidence.agreement:.0%} of the map in view seen'
            self._doubt(text)
            return evidence
        self._supported = self._stamp
        self._confirmed += 1
        if self._state == TRACKING:
            if not self._unchecked:  # else a wrong place would have later searches ask for less
                self._typical = 0.9 * self._typical + 0.1 * np.array(evidence[:3])
            self._prior = expected(self._place @ self._odometry.matrix)
        if self._state != TRACKING and self._confirmed >= part.confirmations:
            if not self._typical.any():
                self._typical = np.array(evidence[:3])
            self._state, self._reason = TRACKING, f'{self._confirmed} frames in a row agree with the map'
        return evidence

    def _enough(self, worse: float) -> tuple[float, float]:
        """Return what a place must reach that is as good as those tracked: closeness, agreement.

        What disagrees may be ``worse`` times as much.
        """
        if not self._typical.any():
            return np.inf, np.inf
        return SIMILAR * self._typical[0], 1.0 - worse * (1.0 - self._typical[2])

    def _evidence(self, frame: Frame, matrix: np.ndarray) -> Evidence:
        """Weigh the place by a frame that was seen from ``matrix`` (4, 4) in the odometry's frame."""
        return weigh(*frame.sample(1000), self._level.near, self._level.points, self._place @ matrix, (frame.view,))

    def _confirms(self, evidence: Evidence) -> bool:
        """Return whether a frame supports the place.

        Where no pose is given out yet, as those tracked did, or as what the place was found by: other parts of the map
        may be worse.
        """
        closeness, agreement = self._enough(WORSE)
        asked_less = self._state == TRACKING or not np.isfinite(closeness)
        least = min(closeness, SIMILAR * self._close), agreement
        return self._good(evidence) and (asked_less or evidence.reaches(least))

    def _good(self, evidence: Evidence) -> bool:
        part = self.config.tracking
        return evidence.share >= part.min_on_map and evidence.agreement >= part.min_agreement

    def _refine(self, frame: Frame, matrix: np.ndarray) -> None:
        """Lay the map in view of a frame, which has ``matrix`` in the odometry's frame, on what was seen lately."""
        inverse = np.linalg.inv(self._place)
        view = frame.view._replace(matrix=matrix)
        visible = np.flatnonzero(seen(self._level.points, inverse, view, 0.15) > 0)
        if len(visible) < 50:
            return
        fit = self._laid(np.sort(self._rng.permutation(visible)[:SAMPLES]), inverse)
        gain = GAIN if self._state == TRACKING else 1.0  # a place just found has no past to be steadied by
        self._place = between(self._place, self._centred(np.linalg.inv(fit.matrix)), gain)
        self._covariance = self._covariance_of(fit)
        self._follow_scale(frame, matrix)

    def _laid(self, chosen: np.ndarray, start: np.ndarray) -> Fit:
        """Lay chosen points of the map on what was seen lately, the scale kept."""
        points, normals = self._level.points[chosen], self._level.normals[chosen]
        return align_through(points, normals, self._odometry.model[1:], start, iterations=5)

    def _centred(self, place: np.ndarray) -> np.ndarray:
        """Return a place half-way to where what was seen lately lies best on the map: the two err differently."""
        points, normals = localization.sampled(_seen(self._recent[::-BETWEEN][:LATELY]), SAMPLES)
        near = self._level.near
        return between(place, align(points, normals, near, place, (near.voxel,), iterations=5).matrix, 0.5)

    def _follow_scale(self, frame: Frame, matrix: np.ndarray) -> None:
        """Let the place follow what is believed of the scale, about what the newest frame saw, which stays."""
        self._scale = self._scale.followed()
        center = localization.moved(matrix, frame.points.mean(axis=0))
        self._place = self._place @ scaling(self._scale.value / scale_of(self._place), center)

    def _recheck(self) -> None:
        """Have it found out, beside what goes on, whether what was seen lies better elsewhere or at another scale.

        The place first by what was seen since it was found, everywhere where it was sought; then, as the scale each
        time, by all that was seen lately.
        """
        fresh = [item for item in self._recent if item[0] > self._checked]
        first = self._unchecked
        if self._check is not None or _span(fresh) < (SOON if first else EVERY):
            return
        items, sensor = self._recent, self._odometry.matrix
        prior = expected(self._place @ sensor, ASTRAY)
        query = Query(_seen(items), self._voxel, self._scale.value, prior, sensor, self._enough(ELSEWHERE))
        if first:
            since = [item for item in items if item[0] >= self._found.stamp]
            query = query._replace(fresh=_seen(since), prior=self._found.prior or prior)
        inputs = query, self._map, self._place, self._drawn()
        self._check = self._segment, _submitted(self._executor, recheck, *inputs)
        self._checked = self._stamp

    def _learn_more(self) -> None:
        """Take the result of a check that has ended."""
        if self._check is None or not self._check[1].done():
            return
        (segment, future), self._check = self._check, None
        second = future.result()
        if second.scale is not None:
            self._scale = self._scale.told(second.scale)
        if segment != self._segment:
            return
        self._unchecked = self._unchecked and not second.told
        if second.matrix is not None:
            self._found = self._found._replace(stamp=self._stamp)
            self._settle_at(second.matrix, second.evidence, 'what was seen since lies better there')

    def _settle_at(self, place: np.ndarray, evidence: Evidence | None, reason: str) -> None:
        """Go on from a place, which frames must confirm before poses are given out."""
        self._place, self._confirmed = place, 0
        self._close = evidence.on_map if evidence else np.inf
        self._unchecked, self._check = True, None  # what is under way is about the place before
        self._supported = self._checked = self._stamp
        self._state, self._reason = LOCALIZING, f'found: {reason}'

    def _drawn(self) -> int:
        """Return another seed: what one search does not hit upon, the next may."""
        return int(self._rng.integers(2**31))

    def _covariance_of(self, fit: Fit) -> np.ndarray:
        """Return the covariance of the sensor's pose in the metric map."""
        sigma = max(fit.rms, 0.2 * self._voxel)
        information = fit.information / (CORRELATION * sigma**2)
        covariance = np.linalg.inv(information + 1e-2 * np.eye(6)) + np.diag(
            (FLOOR[1] ** 2,) * 3 + (FLOOR[0] ** 2,) * 3
        )
        arm = self._odometry.matrix[:3, 3] - fit.pivot
        cross = np.array(((0, -arm[2], arm[1]), (arm[2], 0, -arm[0]), (-arm[1], arm[0], 0)))
        jacobian = np.zeros(
            (6, 6)
        )  # from (rotation, translation) at the pivot to (translation, rotation) at the sensor
        jacobian[:3, :3], jacobian[:3, 3:], jacobian[3:, :3] = -cross, np.eye(3), np.eye(3)
        covariance = jacobian @ covariance @ jacobian.T
        rotation = self._place[:3, :3] / scale_of(self._place)
        turn = np.kron(np.eye(2), rotation)
        return turn @ covariance @ turn.T

    def _doubt(self, reason: str) -> None:
        """Give out nothing for now; after a while without support, say that the pose is lost."""
        if self._state == TRACKING:
            self._state, self._reason = LOCALIZING, reason
        alone = self._stamp - self._supported
        if self._state == LOCALIZING and self._place is not None and alone > self.config.tracking.lost_after:
            self._state, self._reason = LOST, f'no evidence for {alone:.1f} s: {reason}'

    def _break(self, reason: str) -> None:
        """Begin a new stretch of odometry: where the sensor is, is unknown."""
        self._odometry = None
        self._recent = []
        self._lose(LOST, reason)

    def _lose(self, state: str, reason: str) -> None:
        self._segment += 1
        self._candidates, self._looked = None, -np.inf
        self._place, self._confirmed = None, 0
        self._state, self._reason = state, reason

    def _seek(self, stamp: float) -> None:
        """Start a search where none runs and enough was seen."""
        part = self.config.tracking
        stale = self._place is None or stamp - self._supported > part.lost_after
        if self._job is not None or not stale:
            return
        known = self._scale.known
        wide = _span(self._recent) >= part.first_seconds * (0.5 if known else 1.0)
        if not wide and not (known and self._prior is not None):
            return  # near where it is expected few frames will do
        fresh = [item for item in self._recent if item[0] > self._looked]
        if wide and self._looked > -np.inf and not _span(fresh) >= FRESH * part.first_seconds:
            return  # the same frames again would tell the same
        scale = self._scale.value if known else None
        reach = REACHES[self._searches % len(REACHES)]
        sensor = self._odometry.matrix
        enough = self._enough(FOUND[len(self._recent) >= LEAST_FRAMES])
        query = Query(_seen(self._recent), self._voxel, scale, self._prior, sensor, enough, wide, reach)
        if self._candidates is not None:
            query = query._replace(candidates=self._candidates, fresh=_seen(fresh))
        inputs = query, self._map, self.config, self._drawn(), self._closed
        self._job = Job(self._segment, stamp, sensor, self._prior, _submitted(self._executor, search, *inputs))
        self._looked = stamp if wide else self._looked
        if self._state == LOST:
            self._state, self._reason = LOCALIZING, f'searching: {self._reason}'
        self._collect()

    def _collect(self) -> None:
        """Take the result of a search that has ended."""
        job = self._job
        if job is None or not job.future.done():
            return
        self._job = None
        found = _outcome(job.future)
        settled = self._scale.known
        if found.matrix is not None:
            self._learn(found.matrix, found.evidence, job.sensor)
        if job.segment != self._segment:
            return
        self._candidates = found.candidates
        if found.matrix is None:
            self._searches += found.candidates is None or found.candidates.looks == 1
            if self._searches > len(REACHES) and self._scale.unconfirmed:
                self._scale, self._check, self._prior, self._searches = Scale(), None, None, 0
            if self._place is None:
                self._reason = f'not found: {found.reason}'
            return
        self._searches = 0
        self._found = job
        self._settle_at(found.matrix, found.evidence, found.reason)
        self._level = self._map.level(self._voxel * self._scale.value)
        if settled:  # else frames may say so only once the place is found at the scale that is just known
            for stamp, frame, matrix in self._recent:
                self._confirmed += stamp >= job.stamp and self._confirms(self._evidence(frame, matrix))

    def _learn(self, matrix: np.ndarray, evidence: Evidence | None, sensor: np.ndarray) -> None:
        """Keep what a place tells beyond its stretch of odometry, even if that has ended meanwhile."""
        if self._scale.known:
            return
        self._scale = Scale.found(scale_of(matrix))
        self._prior = self._prior or expected(matrix @ sensor)
        if evidence is not None and not self._typical.any():
            self._typical = np.array(evidence[:3])


def warm_up() -> None:
    """Compile every kernel, or load it from the disk, by following a sensor that stands still in a corner."""
    faces = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 4000, 3))
    for axis in range(3):
        faces[axis, :, axis] = 1.0
    corner = faces.reshape(-1, 3) + np.array((0.0, 0.0, 2.0))
    session = Session(corner)
    frame = frames.prepared(corner, frames.resolution(corner, session.config.tracking.resolution))
    session._voxel, session._scale = 0.03, Scale.found(1.0)
    session._move(frame, 0.0, None)
    session._place, session._level = np.eye(4), session._map.level(0.03)
    session._judge(frame)
    session._prior, session._typical = expected(np.eye(4)), np.array((1e-3, 0.0, 0.5))
    parts = [(frame, np.eye(4))] * LEAST_FRAMES
    for scale, prior in ((1.0, session._prior), (None, None)):
        search(Query(parts, 0.03, scale, prior, np.eye(4), (0.0, 0.0)), session._map, session.config, 0)


def _span(items: list[tuple[float, Frame, np.ndarray]]) -> float:
    """Return the seconds from the first to the last of some frames; negative where there is none."""
    return items[-1][0] - items[0][0] if items else -1.0


def _seen(items: list[tuple[float, Frame, np.ndarray]]) -> list[tuple[Frame, np.ndarray]]:
    return [(frame, matrix) for _, frame, matrix in items]


def _submitted(executor: Executor | None, work: Callable, *inputs) -> Future:
    if executor is not None:
        return executor.submit(work, *inputs)
    future: Future = Future()
    try:
        future.set_result(work(*inputs))
    except Exception as error:
        future.set_exception(error)
    return future


def _outcome(future: Future) -> Found:
    """Return what a search found; a submap that cannot be searched for is not found."""
    try:
        return future.result()
    except CsgmError as error:
        return Found(None, str(error))


def _frame_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.dtype.kind not in 'iuf' or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f'frame: {points.dtype} of shape {points.shape}; give an (N, 3) array of x, y, z in metres')
    return frames.returns(points)
