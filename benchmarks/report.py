"""How large a report of two clouds is, how fast it opens, and how smoothly its view moves in a real browser.

``python benchmarks/report.py`` prints a table; ``--screenshots FOLDER`` also keeps what the pages look like, under the
true transform and under a wrong one. It needs chromium and chromium-driver (Debian's packages). WebGL is drawn by the
processor here, so a machine with a graphics card only does better.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import tables
from benchmarks.browser import chromium, missing, opened
from csgm_ros.config import flatten, profile
from csgm_ros.demo.simulation import simulate
from csgm_ros.io.files import CloudFile
from csgm_ros.types import Hypothesis, Similarity, Term
from csgm_ros.visual.report import write_report
from csgm_ros.visual.report_data import ReportData

COUNTS = 20_000, 200_000, 1_000_000
FRAMES = 60
HEADER = (
    *('points of each cloud', 'page, MB', 'written, CPU s', 'opened, s', 'frames a second while it turns'),
    *('of these points', 'wheel to frame, ms', 'all points, ms'),
)


def turned(truth: Similarity, degrees: float = 25.0, shift: float = 0.3) -> Similarity:
    """Return a transform that is wrong by so much, about the vertical of the target."""
    turn = np.radians(degrees)
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    return Similarity(1.0, rotation, np.array([shift, 0.0, 0.0])) @ truth


def page(count: int, poses: tuple[Similarity, ...], accepted: bool = True) -> ReportData:
    """Return a report of the simulated pair, resampled to so many points with a millimetre of noise."""
    made, rng = simulate(0), np.random.default_rng(0)
    clouds = []
    for points, colors in ((made.source, made.source_colors), (made.target, made.target_colors)):
        points, colors = points.reshape(-1, 3).astype(float), colors.reshape(-1, 3)
        kept = np.flatnonzero(np.isfinite(points).all(axis=1))
        kept = kept[rng.integers(0, len(kept), count)]
        clouds.append(CloudFile(points[kept] + rng.normal(0, 1e-3, (count, 3)), colors[kept]))
    return ReportData(
        names=('sfm.ply', 'kinect.ply'),
        source=clouds[0],
        target=clouds[1],
        accepted=accepted,
        reason='the true transform' if accepted else 'a wrong transform',
        poses=tuple(Hypothesis(pose, 0.5 - 0.1 * k, 0.4, 0.3, 1 - 0.2 * k) for k, pose in enumerate(poses)),
        terms=(Term('margin', 4.0 if accepted else 1.1, 2.3, True, 'verification.min_margin'),),
        inlier_distance=0.06,
        match_distance=0.2,
        parameters=flatten(profile()),
        defaults=flatten(profile()),
    )


def measured(browser, count: int, folder: Path) -> tuple:
    """Return a line of the table."""
    truth, path = simulate(0).truth, folder / f'{count}.html'
    data = page(count, (truth, *(turned(truth, 10.0 * k) for k in range(1, 4))))
    begin = time.process_time()
    write_report(path, data)
    written, begin = time.process_time() - begin, time.perf_counter()
    opened(browser, path)
    ready = time.perf_counter() - begin
    found = browser.execute_async_script(f'csgm.bench({FRAMES}).then(arguments[0])')
    times = f'{found["latency_ms"]:.0f}', f'{found["all_points_ms"]:.0f}'
    size = f'{path.stat().st_size / 1e6:.1f}'
    moving = f'{found["points_moving"]:,}'
    return f'{count:,}', size, f'{written:.1f}', f'{ready:.1f}', f'{found["fps"]:.0f}', moving, *times


def screenshots(browser, folder: Path) -> None:
    """Keep what a right and a wrong page look like, whole and as three views."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = simulate(0).truth
    for name, accepted in (('right', True), ('wrong', False)):
        path = folder / f'{name}.html'
        write_report(path, page(60_000, (truth if accepted else turned(truth), turned(truth, 60.0)), accepted))
        browser.set_window_size(1400, 1000)
        opened(browser, path)
        height = browser.execute_script('return document.documentElement.scrollHeight')
        browser.set_window_size(1400, height + 200)
        opened(browser, path)
        browser.save_screenshot(str(folder / f'{name}.png'))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='the smallest page alone')
    parser.add_argument('--screenshots', type=Path, metavar='FOLDER')
    parser.add_argument('--results', type=Path, default=tables.RESULTS)
    options = parser.parse_args()
    if missing():
        print(f'left out, as {" and ".join(missing())} is not installed: apt-get install chromium chromium-driver')
        return
    with chromium() as browser, tempfile.TemporaryDirectory() as folder:
        browser.set_script_timeout(120)
        lines = [measured(browser, count, Path(folder)) for count in (COUNTS[:1] if options.quick else COUNTS)]
        text = (
            f'Chromium {browser.capabilities["browserVersion"]}, headless, WebGL by SwiftShader on the processor; four '
            'hypotheses. At most 200,000 points of a cloud are in the page; while the view moves, as many are drawn as '
            'the machine draws in 40 ms, and all of them once it rests.\n\n' + tables.table(HEADER, lines)
        )
        if options.screenshots:
            screenshots(browser, options.screenshots.resolve())
    tables.report('report', 'The report in a browser', text, options.results)


if __name__ == '__main__':
    main()
