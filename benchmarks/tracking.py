"""A moving depth sensor in a map of unknown scale, beside trackers that are told the scale and the first pose."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from csgm_ros import Session
from csgm_ros.cloud.cells import cells, working_size
from csgm_ros.io.files import read_cloud
from csgm_ros.tracking.localization import moved, scale_of
from csgm_ros.tracking.maps import prepare_map
from csgm_ros.tracking.odometry import between
from csgm_ros.types import rotation_angle

ON_MAP, OFF_MAP, BLOCKED = 1, 2, 3
RESULTS = Path(__file__).resolve().parent / 'results'
RIGHT = 0.10, 5.0, 0.06  # the rule of the data: metres, degrees, relative scale
CLEAR = 1.5  # seconds
UNBROKEN = 0.5  # seconds from one frame to the next
WRONG = 0.20, 10.0
MIN_POINTS = 200
STRANGERS = tuple(
    map(
        Path,
        (
            'sequence_kitchen/map.ply',
            'sequence_desk/map.ply',
            'places/cubicle_1/source.ply',
            'places/bin_shelf/source.ply',
            'places/phone_desk/source.ply',
            'unrelated/office_corner_lidar_1.ply',
            'unrelated/home_living_tango.ply',
        ),
    )
)


class Sequence:
    """Depth frames, a map, and the truth; of ``clock`` seconds later, where its clock is not that of the frames."""

    def __init__(self, folder: Path, clock: float = 0.0):
        with np.load(folder / 'frames.npz') as file:
            self.depth, self.stamps, self.truth, camera, self.state, self.event = (
                file[name] for name in ('depth', 'stamp', 'T_map_camera', 'K', 'state', 'event')
            )
        self.name = folder.name.removeprefix('sequence_')
        self.map = read_cloud(folder / 'map.ply').points
        self.scale = scale_of(self.truth[0])
        if clock:
            self.truth = later(self.truth, self.stamps, clock)
        v, u = np.mgrid[: self.depth.shape[1], : self.depth.shape[2]]
        rays = ((u - camera[0, 2]) / camera[0, 0], (v - camera[1, 2]) / camera[1, 1], np.ones(u.shape))
        self._rays = np.stack(rays, axis=-1)

    def __len__(self) -> int:
        return len(self.stamps)

    def points(self, number: int) -> np.ndarray:
        """Return the returns of a frame, (N, 3) metres."""
        depth = self.depth[number] / 1000.0
        return (self._rays * depth[..., None])[depth > 0]

    def errors(self, number: int, matrix: np.ndarray) -> tuple[float, float, float]:
        """Return displacement in metres, angle in degrees and relative scale, as the README's rule has them."""
        truth, points, scale = self.truth[number], self.points(number), scale_of(matrix)
        shift = np.linalg.norm(moved(matrix, points) - moved(truth, points), axis=1).mean() / self.scale
        turn = (matrix[:3, :3] / scale) @ (truth[:3, :3] / self.scale).T
        return float(shift), float(np.degrees(rotation_angle(turn))), scale / self.scale - 1


def later(poses: np.ndarray, stamps: np.ndarray, seconds: float) -> np.ndarray:
    """Return similarities (N, 4, 4) interpolated some seconds after their stamps, as they are beside a break."""
    found = poses.copy()
    before = np.clip(np.searchsorted(stamps, stamps + seconds) - 1, 0, len(stamps) - 2)
    for n, k in enumerate(before):
        if stamps[k + 1] - stamps[k] < UNBROKEN:
            share = (stamps[n] + seconds - stamps[k]) / (stamps[k + 1] - stamps[k])
            found[n] = between(poses[k], poses[k + 1], share)
    return found


class QuietMachine:
    """An executor whose results are there after the CPU seconds that they took, whoever else runs."""

    def __init__(self):
        self.now, self.seconds = 0.0, []

    def submit(self, function, *arguments) -> Future:
        """Run at once, deliver later."""
        started, clock, inner = time.process_time(), self, Future()
        try:
            inner.set_result(function(*arguments))
        except Exception as error:
            inner.set_exception(error)
        self.seconds.append(time.process_time() - started)
        ready = self.now + self.seconds[-1]

        class Delayed(Future):
            def done(self) -> bool:
                return clock.now >= ready

            def result(self, timeout=None):
                return inner.result(timeout)

        return Delayed()


def replay(sequence: Sequence, numbers, seed: int = 0, session: Session | None = None, offset: float = 0.0):
    """Feed frames; return (number, Estimate, CPU seconds of the frame) of each, and the CPU seconds of the searches."""
    machine = QuietMachine()
    session = session or Session(sequence.map, seed=seed, executor=machine)
    rows = []
    for number in numbers:
        points = sequence.points(number)
        machine.now = offset + sequence.stamps[number]
        searched, started = sum(machine.seconds), time.process_time()
        estimate = session.add(points, machine.now)
        rows.append((number, estimate, time.process_time() - started - (sum(machine.seconds) - searched)))
    return rows, machine.seconds


def report(sequence: Sequence, rows) -> dict[str, object]:
    """Return what the goals ask of one replay."""
    given = {n: e for n, e, _ in rows if e.T_map_sensor is not None and len(sequence.points(n)) >= MIN_POINTS}
    on_map = [n for n, _, _ in rows if sequence.state[n] == ON_MAP]
    errors = {n: sequence.errors(n, e.T_map_sensor) for n, e in given.items()}
    judged = [n for n in on_map if n in given]
    right = [n for n in judged if all(abs(e) < limit for e, limit in zip(errors[n], RIGHT, strict=True))]
    wrong = [n for n in judged if errors[n][0] > WRONG[0] or errors[n][1] > WRONG[1]]
    out = {'sequence': sequence.name, 'frames on the map': len(on_map), 'given': len(judged), 'right': len(right)}
    out |= {'wrong (20 cm, 10 deg)': len(wrong), 'claims off the map or blocked': 0}
    out['claims off the map or blocked'] = sum(
        e.T_map_sensor is not None and sequence.state[n] in (OFF_MAP, BLOCKED) for n, e, _ in rows
    )
    if not judged:
        return out
    out['right of given'] = len(right) / len(judged)
    out['right of all'] = len(right) / len(on_map)
    out['right of all since the first pose'] = len(right) / sum(n >= min(given) for n in on_map)
    out['displacement median m'] = float(np.median([errors[n][0] for n in judged]))
    out['rotation median deg'] = float(np.median([errors[n][1] for n in judged]))
    out |= trajectory(sequence, {n: given[n].T_map_sensor for n in judged})
    out['first pose after s'] = float(sequence.stamps[min(given)] - sequence.stamps[rows[0][0]])
    late = [n for n in judged if sequence.stamps[n] - sequence.stamps[min(given)] > 10]
    out['scale error after 10 s'] = float(np.median([abs(errors[n][2]) for n in late])) if late else None
    if len(late) > 2:
        slope = np.polyfit(sequence.stamps[late], [np.log(given[n].scale) for n in late], 1)[0]
        out['scale drift a minute, after 10 s'] = float(abs(slope) * 60)
    seconds = [s for n, e, s in rows if e.state == 'tracking']
    out['latency median, 95 % ms'] = [round(1e3 * float(q)) for q in np.quantile(seconds, (0.5, 0.95))]
    out['errors over sigma'] = calibration(sequence, {n: given[n] for n in judged})
    return out


def trajectory(sequence: Sequence, poses: dict[int, np.ndarray], interval: float = 1.0) -> dict[str, float]:
    """Return absolute (after rigid alignment, Umeyama) and relative trajectory errors of the sensor, metres."""
    from csgm_ros.transform.similarity import umeyama

    numbers = sorted(poses)
    found = np.array([poses[n][:3, 3] for n in numbers]) / sequence.scale
    truth = np.array([sequence.truth[n][:3, 3] for n in numbers]) / sequence.scale
    aligned = umeyama(found, truth, estimate_scale=False).apply(found)
    out = {'ATE rmse m': float(np.sqrt(((aligned - truth) ** 2).sum(1).mean()))}
    steps = []
    for a in numbers:
        b = next((n for n in numbers if sequence.stamps[n] - sequence.stamps[a] >= interval), None)
        if b is not None and sequence.stamps[b] - sequence.stamps[a] < 1.5 * interval:
            ours = np.linalg.inv(poses[a]) @ poses[b]
            true = np.linalg.inv(sequence.truth[a]) @ sequence.truth[b]
            steps.append(np.linalg.norm((np.linalg.inv(true) @ ours)[:3, 3]))
    out['RPE rmse m (1 s)'] = float(np.sqrt(np.mean(np.square(steps)))) if steps else None
    return out


def calibration(sequence: Sequence, given) -> list[float]:
    """Return the RMS of error over sigma of the sensor's place and of its direction; 1 is calibrated."""
    ratios = []
    for n, estimate in given.items():
        truth, matrix = sequence.truth[n], estimate.T_map_sensor
        shift = (matrix[:3, 3] - truth[:3, 3]) / sequence.scale
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix((matrix[:3, :3] / scale_of(matrix)) @ (truth[:3, :3] / sequence.scale).T)
        sigma = np.sqrt(np.diag(estimate.covariance))
        ratios.append(np.concatenate((shift, turn.as_rotvec())) / sigma)
    ratios = np.array(ratios)
    return [round(float(np.sqrt((part**2).mean())), 2) for part in (ratios[:, :3], ratios[:, 3:])]


def starts(
    sequence: Sequence,
    count: int,
    rng: np.random.Generator,
    longest: float = 3.0,
    map_points: np.ndarray | None = None,
) -> dict[str, object]:
    """Localise from random starts on the map, with no more than ``longest`` seconds of frames.

    Starts are drawn among the frames that :data:`CLEAR` seconds on the map follow: a place is sought after one second.
    In the map of another place, where ``map_points`` has one, every pose is wrong.
    """
    on_map = np.array([n for n in np.flatnonzero(sequence.state == ON_MAP) if _clear(sequence, n) >= CLEAR])
    right = wrong = 0
    prepared = prepare_map(sequence.map if map_points is None else map_points)
    work, waited = [], []
    for first in rng.permutation(on_map)[:count]:
        spell = [n for n in range(first, len(sequence)) if sequence.stamps[n] - sequence.stamps[first] <= longest]
        seconds, verdict = 0.0, None
        session = Session(prepared)
        for n in spell:
            started = time.process_time()
            estimate = session.add(sequence.points(n), sequence.stamps[n])
            seconds += time.process_time() - started
            if estimate.T_map_sensor is not None:
                errors = sequence.errors(n, estimate.T_map_sensor)
                right_here = all(abs(e) < limit for e, limit in zip(errors, RIGHT, strict=True))
                verdict = right_here and map_points is None
                waited.append(sequence.stamps[n] - sequence.stamps[first])
                break
        right, wrong = right + (verdict is True), wrong + (verdict is False)
        work.append(seconds)
    n = len(work)
    return {
        'sequence': sequence.name,
        'frames to start from': len(on_map),
        'starts': n,
        'right': right,
        'wrong': wrong,
        'none': n - right - wrong,
    } | {
        'work median s': float(np.median(work)),
        'frames used median s': float(np.median(waited)) if waited else None,
    }


def strangers(sequence: Sequence, count: int, seed: int) -> list[dict[str, object]]:
    """Look for a sensor in maps of places where it is not, and in one that holds its place twice."""
    data, found = Path(os.environ['CSGM_SHARED']) / 'data', []
    for path in STRANGERS:
        if path.parts[0] != f'sequence_{sequence.name}':
            rng = np.random.default_rng(seed)
            found.append({'map': str(path)} | starts(sequence, count, rng, map_points=read_cloud(data / path).points))
    points = twice(sequence.map)
    found.append({'map': 'its own, twice'} | starts(sequence, count, np.random.default_rng(seed), map_points=points))
    return found


def twice(points: np.ndarray) -> np.ndarray:
    """Return a map (M, 3) that holds a place twice, side by side along a floor and a wall, half of its points each."""
    made = cells(points, working_size(points, 4000), 40000, np.random.default_rng(0))
    first, *others = (plane.normal for plane in made.planes)
    upright = (normal for normal in others if abs(first @ normal) < 0.5)
    aside = np.cross(first, next(upright, np.eye(3)[np.abs(first).argmin()]))
    aside *= 1.5 * np.ptp(points @ aside) / (aside @ aside)
    order = np.random.default_rng(0).permutation(len(points))
    return np.concatenate([points[order[::2]], points[order[1::2]] + aside])


def _clear(sequence: Sequence, first: int) -> float:
    """Return for how many seconds from a frame on the sensor sees the map without a break."""
    n = first
    while n + 1 < len(sequence) and sequence.state[n + 1] == ON_MAP:
        if sequence.stamps[n + 1] - sequence.stamps[n] > UNBROKEN:
            break
        n += 1
    return float(sequence.stamps[n] - sequence.stamps[first])


def peers(sequence: Sequence) -> list[dict[str, object]]:
    """Run trackers that are told the true scale and the true first pose, on the same frames."""
    found = []
    for name, track in (('open3d', with_open3d), ('small_gicp', with_small_gicp), ('kiss-icp', with_kiss_icp)):
        try:
            poses, seconds = track(sequence)
        except ImportError:
            print(f'{name} is not installed: left out', file=sys.stderr)
            continue
        judged = [n for n in poses if sequence.state[n] == ON_MAP]
        errors = {n: sequence.errors(n, poses[n]) for n in judged}
        right = sum(all(abs(e) < limit for e, limit in zip(errors[n], RIGHT, strict=True)) for n in judged)
        out = {'sequence': sequence.name, 'method': name, 'right of all': right / len(judged)}
        out['displacement median m'] = float(np.median([errors[n][0] for n in judged]))
        out |= trajectory(sequence, {n: poses[n] for n in judged})
        out['latency median, 95 % ms'] = [round(1e3 * float(q)) for q in np.quantile(seconds, (0.5, 0.95))]
        found.append(out)
    return found


def _frames(sequence: Sequence):
    for n in range(len(sequence)):
        points = sequence.points(n)
        if len(points) >= MIN_POINTS:
            yield n, points[::10]


def with_open3d(sequence: Sequence):
    """Frame to map, point to plane."""
    import open3d

    registration = open3d.pipelines.registration
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(sequence.map / sequence.scale))
    cloud = cloud.voxel_down_sample(0.03)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(20))
    unit = np.diag((sequence.scale,) * 3 + (1.0,))

    def step(points, guess):
        frame = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(0.03)
        plane = registration.TransformationEstimationPointToPlane()
        return registration.registration_icp(frame, cloud, 0.15, guess, plane).transformation

    return _followed(sequence, step, unit)


def with_small_gicp(sequence: Sequence):
    """Frame to map, generalised ICP."""
    import small_gicp

    cloud, tree = small_gicp.preprocess_points(sequence.map / sequence.scale, downsampling_resolution=0.03)
    unit = np.diag((sequence.scale,) * 3 + (1.0,))

    def step(points, guess):
        frame, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.03)
        return small_gicp.align(cloud, frame, tree, guess, max_correspondence_distance=0.15).T_target_source

    return _followed(sequence, step, unit)


def _followed(sequence: Sequence, step, unit: np.ndarray):
    """Follow with constant velocity from the true first pose."""
    poses, seconds, last, before = {}, [], None, None
    for n, points in _frames(sequence):
        started = time.process_time()
        if last is None:
            metric = np.linalg.inv(unit) @ sequence.truth[n]
        else:
            metric = step(points, last @ np.linalg.inv(before) @ last)
        before, last = (metric if last is None else last), metric
        seconds.append(time.process_time() - started)
        poses[n] = unit @ metric
    return poses, seconds


def with_kiss_icp(sequence: Sequence):
    """Odometry from the true first pose."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 8.0, 0.2, False
    config.mapping.voxel_size = 0.05
    odometry, poses, seconds, first = KissICP(config), {}, [], None
    for n, points in _frames(sequence):
        started = time.process_time()
        odometry.register_frame(points, np.zeros(len(points)))
        seconds.append(time.process_time() - started)
        first = sequence.truth[n] @ np.linalg.inv(odometry.last_pose) if first is None else first
        poses[n] = first @ odometry.last_pose
    return poses, seconds


def hours(sequence: Sequence, minutes: float) -> dict[str, object]:
    """Replay in a loop; return time per frame and memory of the first and the last tenth."""
    session, times, memory, span, loop = Session(sequence.map), [], [], sequence.stamps[-1] + 5.0, 0
    while loop * span < 60 * minutes:
        rows, _ = replay(sequence, range(len(sequence)), session=session, offset=loop * span)
        times += [s for _, e, s in rows if e.state == 'tracking']
        memory.append(_resident())
        loop += 1
    tenth = max(len(times) // 10, 1)
    return {'sequence': sequence.name, 'minutes': minutes, 'frames': len(times)} | {
        'ms a frame, first and last tenth': [round(1e3 * float(np.median(t))) for t in (times[:tenth], times[-tenth:])],
        'MB after the second and the last loop': [memory[min(1, len(memory) - 1)], memory[-1]],
    }


def _resident() -> int:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') >> 20


def warm_up(sequence: Sequence) -> None:
    """Load and compile the kernels: their seconds are nobody's."""
    session = Session(sequence.map)
    for n in range(12):
        session.add(sequence.points(n), sequence.stamps[n])
    session.relocalize()
    for n in range(12, 24):
        session.add(sequence.points(n), sequence.stamps[n])


def main() -> None:
    """Print every table and keep it as results/tracking.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sequences', nargs='+', default=['kitchen', 'desk'])
    parser.add_argument('--parts', nargs='+', default=['replay', 'peers', 'starts', 'strangers', 'hours'])
    parser.add_argument('--starts', type=int, default=25, help='random starts in each sequence (%(default)s)')
    parser.add_argument('--seed', type=int, default=0, help='of the replay and of the random starts (%(default)s)')
    parser.add_argument(
        '--clock', type=float, default=0.0, help='seconds after a frame of which the truth is taken (%(default)s)'
    )
    parser.add_argument('--minutes', type=float, default=30.0, help='of looped replay (%(default)s)')
    parser.add_argument('--quick', action='store_true', help='few frames of one sequence, to see that it works')
    parser.add_argument('--results', type=Path, default=RESULTS)
    options = parser.parse_args()
    if 'CSGM_SHARED' not in os.environ:
        print('CSGM_SHARED does not name the folder with the sequences: nothing to measure')
        return
    if options.quick:
        options.sequences, options.parts = ['kitchen'], ['replay']
    options.results.mkdir(parents=True, exist_ok=True)
    file = options.results / 'tracking.json'
    kept = json.loads(file.read_text()) if file.exists() else {}
    for name in options.sequences:
        sequence = Sequence(Path(os.environ['CSGM_SHARED']) / 'data' / f'sequence_{name}', options.clock)
        warm_up(sequence)
        runs = {
            'replay': lambda s=sequence: report(s, replay(s, range(40 if options.quick else len(s)), options.seed)[0]),
            'peers': lambda s=sequence: peers(s),
            'starts': lambda s=sequence: starts(s, options.starts, np.random.default_rng(options.seed)),
            'strangers': lambda s=sequence: strangers(s, options.starts, options.seed),
            'hours': lambda s=sequence: hours(s, options.minutes),
        }
        for part in options.parts:
            found = runs[part]()
            print(json.dumps(found, indent=1), flush=True)
            kept[f'{name} {part}' + (f', clock {options.clock:+g}' if options.clock else '')] = found
            if not options.quick:
                file.write_text(json.dumps(kept, indent=1) + '\n')


if __name__ == '__main__':
    main()
