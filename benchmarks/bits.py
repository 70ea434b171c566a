"""Print a digest of every result on the real pairs, to see whether a change of the code changed any of them.

``python benchmarks/bits.py > before.txt``, then the change, then the same again and ``diff``.
"""

import argparse
import hashlib
import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import csgm_ros
from csgm_ros.config import replaced


def pairs(shared: Path):
    """Yield (name, source file, target file) of every pair in the shared data."""
    for folder in sorted((shared / 'data').glob('kinect_sfm/*')):
        yield folder.name, folder / 'sfm.ply', folder / 'kinect.ply'
    for folder in sorted((shared / 'data').glob('places/*')):
        yield folder.name, folder / 'source.ply', folder / 'target.ply'


def digest(result) -> str:
    """Return a short hash of the transform, the verdict and the matches, bit for bit."""
    verdict = result.verdict
    numbers = (verdict.fitness_source, verdict.fitness_target, verdict.inlier_rmse, verdict.margin)
    parts = (result.T_target_source, np.array(numbers), result.matches, result.match_inliers)
    said = f'{verdict.accepted} {verdict.reason}'.encode()
    return hashlib.sha256(b''.join(np.ascontiguousarray(part).tobytes() for part in parts) + said).hexdigest()[:16]


def main() -> None:
    """Register every pair in both profiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--profiles', nargs='+', default=['robust', 'rigid', 'paper'])
    parser.add_argument('--seeds', nargs='+', type=int, default=[0])
    parser.add_argument('--only', default='', help='pairs whose name holds this')
    options = parser.parse_args()
    import open3d

    for name, *files in pairs(Path(os.environ['CSGM_SHARED'])):
        if options.only not in name:
            continue
        clouds = [np.asarray(open3d.io.read_point_cloud(str(file)).points) for file in files]
        for profile in options.profiles:
            config = csgm_ros.profile('paper' if profile == 'paper' else 'robust')
            if profile == 'rigid':
                config = replaced(config, {'scale.estimate_scale': False})
            for seed in options.seeds:
                result = csgm_ros.register(*clouds, config, seed=seed)
                print(f'{name:20} {profile:7} {seed} {digest(result)} {result.accepted} {result.scale:.6g}', flush=True)


if __name__ == '__main__':
    main()
