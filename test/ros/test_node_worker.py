"""The worker: one job at a time, the newest waits, cancelling is immediate for who waits."""

import threading
import weakref

import pytest

pytest.importorskip('rclpy')

from csgm_ros.errors import Cancelled
from csgm_ros.ros.worker import Worker

PATIENCE = 10.0


@pytest.fixture
def worker():
    made = Worker()
    yield made
    assert made.stop(PATIENCE)


class Held:
    """Work that reports progress when it starts and when it is let go."""

    def __init__(self):
        self.begun, self.gate = threading.Event(), threading.Event()

    def __call__(self, progress):
        progress('first', 0.25)
        self.begun.set()
        assert self.gate.wait(PATIENCE)
        progress('second', 0.75)
        return 'done'


def submit(worker, work, delivered=None):
    return worker.submit(work, (lambda job: delivered.append(job)) if delivered is not None else lambda job: None)


def test_result_is_delivered_before_who_waits_is_woken(worker):
    delivered, work = [], Held()
    job = submit(worker, work, delivered)
    assert work.begun.wait(PATIENCE)
    assert worker.current is job
    assert (job.stage, job.fraction) == ('first', 0.25)
    assert not delivered
    work.gate.set()
    assert job.done.wait(PATIENCE)
    assert (job.result, job.error, delivered) == ('done', None, [job])
    assert worker.current is None


def test_newer_job_replaces_the_one_that_waits(worker):
    works, delivered = [Held(), Held(), Held()], []
    jobs = [submit(worker, works[0], delivered)]
    assert works[0].begun.wait(PATIENCE)
    jobs += [submit(worker, work, delivered) for work in works[1:]]
    assert jobs[1].done.wait(PATIENCE)
    assert 'newer' in str(jobs[1].error)
    for work in works:
        work.gate.set()
    assert jobs[2].done.wait(PATIENCE)
    assert [job.result for job in jobs] == ['done', None, 'done']
    assert delivered == [jobs[0], jobs[2]]
    assert not works[1].begun.is_set()


def test_cancelled_job_is_over_at_once_and_never_delivered(worker):
    delivered, works = [], [Held(), Held()]
    job = submit(worker, works[0], delivered)
    assert works[0].begun.wait(PATIENCE)
    assert worker.cancel('enough')
    assert job.done.is_set()
    assert isinstance(job.error, Cancelled)
    assert worker.current is None
    assert not worker.cancel('again')
    following = submit(worker, works[1], delivered)  # waits until the cancelled work lets go
    assert not works[1].begun.is_set()
    works[0].gate.set()
    works[1].gate.set()
    assert following.done.wait(PATIENCE)
    assert job.result is None
    assert delivered == [following]


def test_failure_is_told_and_the_next_job_runs(worker):
    def fail(progress):
        raise ValueError('no good')

    job = submit(worker, fail)
    assert job.done.wait(PATIENCE)
    assert str(job.error) == 'no good'
    following = submit(worker, lambda progress: 5)
    assert following.done.wait(PATIENCE)
    assert following.result == 5


def test_delivery_that_fails_is_told_and_does_not_stop_the_worker(worker):
    def refuse(job):
        raise RuntimeError('nobody home')

    job = worker.submit(lambda progress: 1, refuse)
    assert job.done.wait(PATIENCE)
    assert str(job.error) == 'nobody home'
    assert submit(worker, lambda progress: 2).done.wait(PATIENCE)


def test_stopped_worker_takes_no_job():
    worker = Worker()
    assert worker.stop(PATIENCE)
    job = submit(worker, lambda progress: 1)
    assert job.done.is_set()
    assert isinstance(job.error, Cancelled)


def test_only_one_of_many_callers_at_once_gets_its_job_in(worker):
    work, start, found = Held(), threading.Barrier(8), []

    def ask():
        start.wait(PATIENCE)
        found.append(worker.submit_if_idle(work, lambda job: None))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    work.gate.set()
    assert [ours for _, ours in found].count(True) == 1
    assert len({id(job) for job, _ in found}) == 1
    assert found[0][0].done.wait(PATIENCE)


def test_closed_worker_ends_what_runs_and_what_comes(worker):
    work = Held()
    job = submit(worker, work)
    assert work.begun.wait(PATIENCE)
    assert worker.close('the node is not active')
    late = submit(worker, Held())
    work.gate.set()
    assert late.done.is_set()
    assert str(late.error) == str(job.error) == 'the node is not active'
    worker.open()
    assert submit(worker, lambda progress: 3).done.wait(PATIENCE)


class Heavy:
    """Something whose end can be seen."""


@pytest.mark.parametrize('ending', ['result', 'error', 'refused'])
def test_a_finished_job_leaves_nothing_behind(worker, ending):
    inputs, outputs = Heavy(), Heavy()
    ends = [weakref.ref(each) for each in (inputs, outputs)]

    def work(progress, used=inputs, made=outputs):
        if ending == 'error':
            raise ValueError('no good')
        return made

    def deliver(job):
        held = job.result
        if ending == 'refused':
            raise RuntimeError(held)

    job = worker.submit(work, deliver)
    assert job.done.wait(PATIENCE)
    del job, work, deliver, inputs, outputs
    assert submit(worker, lambda progress: 1).done.wait(PATIENCE)  # the thread is past it
    assert [end() for end in ends] == [None, None]
