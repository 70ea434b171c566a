"""LZF, the compression of PCD files: every reference is checked before it is followed."""

from __future__ import annotations

from typing import Any

import numpy as np

from csgm_ros.cloud.kernels import kernel


@kernel
def inflate(packed: np.ndarray, data: np.ndarray) -> int:
    """Decompress into ``data``; return the bytes written, -1 where the data is damaged.

    Parameters
    ----------
    packed, data : (N,), (M,) uint8 ndarray
    """
    read, written = 0, 0
    while read < packed.size:
        control: Any = np.int64(packed[read])
        read += 1
        if control < 32:  # that many bytes and one as they are
            count = control + 1
            if read + count > packed.size or written + count > data.size:
                return -1
            for _ in range(count):
                data[written] = packed[read]
                read += 1
                written += 1
            continue
        count = control >> 5  # a copy of what was written before
        if count == 7:
            if read >= packed.size:
                return -1
            count += np.int64(packed[read])
            read += 1
        if read >= packed.size:
            return -1
        start = written - ((control & 31) << 8) - np.int64(packed[read]) - 1
        read += 1
        count += 2
        if start < 0 or written + count > data.size:
            return -1
        for step in range(count):
            data[written] = data[start + step]
            written += 1
    return written
