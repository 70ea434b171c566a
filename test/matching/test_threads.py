"""One thread for linear algebra, and what was set before afterwards."""

import concurrent.futures
import threading

import pytest

from csgm_ros.matching import blas

switches = blas._switches()
pytestmark = pytest.mark.skipif(switches is None, reason='NumPy does not use OpenBLAS here')


def test_one_thread_inside_and_the_old_number_after_an_error_too():
    get_threads, set_threads = switches
    before, inside = get_threads(), []

    @blas.single_thread()
    def fail():
        inside.append(get_threads())
        raise KeyError

    try:
        set_threads(2)
        with pytest.raises(KeyError):
            fail()
        assert (inside, get_threads()) == ([1], 2)
    finally:
        set_threads(before)


def test_the_last_of_several_users_restores():
    get_threads, _ = switches
    before, both = get_threads(), threading.Barrier(2)

    def use(first):
        with blas.single_thread():
            both.wait(timeout=30)
            seen = [get_threads()]
            if first:
                return seen
            both.wait(timeout=30)  # the first one has left
            return [*seen, get_threads()]

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        leaving, staying = pool.submit(use, True), pool.submit(use, False)
        assert leaving.result() == [1]
        both.wait(timeout=30)
        assert staying.result() == [1, 1]
    assert get_threads() == before
