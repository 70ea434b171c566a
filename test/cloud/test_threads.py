"""Limits of the threads of libraries, and what was set before afterwards."""

import concurrent.futures
import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from csgm_ros.cloud.threads import blas_threads

np.linalg.eigh(np.eye(3))  # BLAS is loaded


def used(library):
    return [pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == library]


def test_one_thread_inside_and_the_old_number_after_an_error_too():
    before, inside = used('blas'), []

    def fail():
        with blas_threads(1):
            inside.extend(used('blas'))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert set(inside) == {1}
    assert used('blas') == before


def test_the_last_of_several_users_restores():
    before, both = used('blas'), threading.Barrier(2)

    def use(first):
        with blas_threads(1):
            both.wait(timeout=30)
            seen = [set(used('blas'))]
            if first:
                return seen
            both.wait(timeout=30)  # the first one has left
            return [*seen, set(used('blas'))]

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        leaving, staying = pool.submit(use, True), pool.submit(use, False)
        assert leaving.result() == [{1}]
        both.wait(timeout=30)
        assert staying.result() == [{1}, {1}]
    assert used('blas') == before
