"""Which of many transforms are different ones."""

from __future__ import annotations

import numpy as np

from csgm_ros.cloud.kernels import kernel


@kernel
def distinct(transforms, order, probe, distance, count):
    """Return the first ``count`` indices of an order whose (H, 4, 4) transforms move (P, 3) points differently.

    No two of them move the points within an RMS displacement of ``distance``.
    """
    images, kept = np.empty((count, *probe.shape)), np.empty(count, np.int64)
    limit, found = distance * distance * len(probe), 0
    for h in order:
        if found == count:
            break
        m, image = transforms[h], images[found]
        for p in range(len(probe)):
            for axis in range(3):
                image[p, axis] = m[axis, 3]
                for k in range(3):
                    image[p, axis] += m[axis, k] * probe[p, k]
        new = True
        for k in range(found):
            apart = 0.0
            for p in range(len(probe)):
                for axis in range(3):
                    apart += (images[k, p, axis] - image[p, axis]) ** 2
                if apart >= limit:
                    break
            if apart < limit:
                new = False
                break
        if new:
            kept[found] = h
            found += 1
    return kept[:found]
