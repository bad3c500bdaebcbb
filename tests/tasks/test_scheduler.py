"""Blocks handed out: which, how many a task, and again where they failed or were lost."""

import tracemalloc

import numpy as np
from test_journal import receipt

from sweep.tasks.engine.dispatcher import (
    BLOCKS_PER_TASK_MAX,
    TARGET_TASK_SECONDS,
    TASKS_PER_SECOND_MAX,
    TaskDispatcher,
    ThroughputEstimator,
    WorkerThreadCounter,
    _InFlightTask,
    task_key,
)
from sweep.tasks.engine.worker import BlockQueue, TaskResult, TaskSettings


def test_blocks_that_are_done_are_not_handed_out():
    is_done = np.array([True, False, False, True, False])
    blocks = BlockQueue(is_done)
    assert blocks.n_unassigned == 3
    assert blocks.take_blocks(2) == [1, 2]
    assert blocks.n_unassigned == 1
    assert blocks.take_blocks(5) == [4]
    assert blocks.take_blocks(5) == []


def test_a_failed_block_comes_back_once_and_alone():
    blocks = BlockQueue(np.zeros(6, bool))
    assert blocks.take_blocks(3) == [0, 1, 2]
    assert blocks.requeue_failed(1)
    assert blocks.take_blocks(3) == [1]
    blocks.requeue([1])
    assert blocks.take_blocks(3) == [1]
    assert blocks.failed_blocks == {1}
    assert not blocks.requeue_failed(1)
    assert blocks.take_blocks(3) == [3, 4, 5]


def test_a_block_that_failed_and_is_put_back_stays_a_suspect():
    """Else it flew beside another suspect, and failed again as that killed their worker."""
    blocks = BlockQueue(np.zeros(6, bool))
    assert blocks.take_blocks(3) == [0, 1, 2]
    assert blocks.requeue_failed(1) and blocks.requeue_failed(2)
    assert blocks.take_blocks(1) == [1]
    blocks.requeue([1, 0])
    assert blocks.take_blocks(1, include_failed=False) == [0]
    assert blocks.take_blocks(1, include_failed=False) == [3]
    assert [blocks.take_blocks(1), blocks.take_blocks(1)] == [[2], [1]]


def test_ten_million_blocks_are_handed_out_without_being_listed():
    is_done = np.zeros(10_000_000, dtype=bool)
    tracemalloc.start()
    blocks = BlockQueue(is_done)
    assert blocks.take_blocks(1000) == list(range(1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000


def pace(seconds_a_block: float) -> ThroughputEstimator:
    return ThroughputEstimator(n_finished_blocks=100, work_seconds=100 * seconds_a_block)


def test_the_first_tasks_have_a_block_each():
    assert ThroughputEstimator().blocks_per_task(10**6, 2) == 1


def test_tasks_take_their_time_on_few_workers():
    assert pace(0.1).blocks_per_task(10**6, 2) == TARGET_TASK_SECONDS / 0.1
    assert pace(30.0).blocks_per_task(10**6, 2) == 1
    assert pace(1e-6).blocks_per_task(10**9, 2) == BLOCKS_PER_TASK_MAX


def test_thousands_of_workers_never_ask_more_of_the_scheduler_than_it_can_do():
    for slots in (100, 1000, 10_000):
        blocks = pace(0.1).blocks_per_task(10**9, slots)
        tasks_a_second = slots / (blocks * 0.1)
        assert tasks_a_second <= TASKS_PER_SECOND_MAX * 1.01


def test_tasks_grow_short_towards_the_end():
    assert pace(0.1).blocks_per_task(80, 10) == 2
    assert pace(0.1).blocks_per_task(3, 10) == 1
    assert pace(0.1).blocks_per_task(0, 10) == 1


def test_a_pace_learns_from_answers():
    estimator = ThroughputEstimator(10, 1000.0)
    estimator.add_task_result(TaskResult(receipts=[receipt(i) for i in range(5)]))
    assert estimator == ThroughputEstimator(15, 1005.0)


class Client:
    """A scheduler with two workers."""

    def nthreads(self):
        return {"tcp://a": 1, "tcp://b": 1}


def test_workers_that_may_come_are_counted_so_that_their_coming_is_asked_for():
    assert WorkerThreadCounter(Client()).current_count() == 2
    assert WorkerThreadCounter(Client(), n_expected_worker_threads=40).current_count() == 40
    assert WorkerThreadCounter(Client(), n_expected_worker_threads=1).current_count() == 2


def test_the_same_work_has_the_same_key_and_other_work_another():
    job = TaskSettings("/store", "id", None)
    assert task_key(job, [1, 2], False) == task_key(
        TaskSettings("/store", "id", None), [1, 2], False
    )
    other_keys = [
        task_key(job, [1, 3], False),
        task_key(job, [1, 2], True),
        task_key(job, [1, 2], False, resend_count=1),
        task_key(TaskSettings("/other", "id", None), [1, 2], False),
        task_key(TaskSettings("/store", "other", None), [1, 2], False),
    ]
    assert len({task_key(job, [1, 2], False), *other_keys}) == 6


def test_an_answer_lost_with_its_worker_whose_second_run_fails_is_a_failure_of_its_blocks():
    """A future may be finished when it is looked at, and failed when its result is asked for."""

    class Lost:
        key, status = "lost", "finished"

        def result(self, timeout):
            raise RuntimeError("killed")

    blocks = BlockQueue(np.zeros(8, dtype=bool))
    scheduler = TaskDispatcher(
        None, 0, TaskSettings("x.zarr", "0", None), blocks, verify_receipt=None, say=None
    )
    scheduler._in_flight["lost"] = _InFlightTask([3, 4], {"lost": Lost()})
    scheduler._finished_futures.put(Lost())
    answer = scheduler._next_result()
    assert [failure.block for failure in answer.failures] == [3, 4] and not answer.receipts
    assert all(failure.error.startswith("RuntimeError") for failure in answer.failures)


def test_a_task_that_is_over_is_not_sent_again_before_its_answer_is_looked_at():
    """A block that kills its worker would kill another, and what is on it."""

    class Sent:
        def __init__(self, key, over=False):
            self.key, self.over = key, over

        def done(self):
            return self.over

        def add_done_callback(self, call):
            pass

    class Idle(Client):
        def __init__(self):
            self.sent = []

        def processing(self):
            return {}

        def submit(self, work, job, blocks, *, key, retries, workers):
            self.sent.append(blocks)
            return Sent(key)

    client, blocks = Idle(), BlockQueue(np.zeros(8, dtype=bool))
    scheduler = TaskDispatcher(
        client, 0, TaskSettings("x.zarr", "0", None), blocks, verify_receipt=None, say=None
    )
    scheduler._thread_counter.current_count()
    for block, over in ((4, True), (5, False)):
        task = _InFlightTask([block], {str(block): Sent(str(block), over)}, last_sent_at=-1e9)
        scheduler._in_flight[str(block)] = task
    scheduler._duplicate_stragglers()
    assert client.sent == [[5]]
