import tracemalloc

import numpy as np

from sweep.tasks.todo import Todo
from sweep.tasks.window import Job, Pace, Window, _Task, task_key
from sweep.tasks.worker import Answer


def test_blocks_that_are_done_are_not_handed_out():
    done = np.array([True, False, False, True, False])
    todo = Todo(done)
    assert todo.left == 3
    assert todo.take(2) == [1, 2]
    assert todo.left == 1
    assert todo.take(5) == [4]
    assert todo.take(5) == []


def test_a_failed_block_comes_back_once_and_alone():
    todo = Todo(np.zeros(6, bool))
    assert todo.take(3) == [0, 1, 2]
    assert todo.again(1)
    assert todo.take(3) == [1]
    todo.put_back([1])
    assert todo.take(3) == [1]
    assert todo.attempt(1) == 1 and todo.attempt(2) == 0
    assert not todo.again(1)
    assert todo.take(3) == [3, 4, 5]


def test_ten_million_blocks_are_handed_out_without_being_listed():
    done = np.zeros(10_000_000, dtype=bool)
    tracemalloc.start()
    todo = Todo(done)
    assert todo.take(1000) == list(range(1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000


def answer(blocks: int) -> Answer:
    from test_journal import receipt

    return Answer(receipts=[receipt(i) for i in range(blocks)], failures=[])


def test_tasks_grow_to_some_seconds_and_shrink_towards_the_end():
    pace = Pace()
    assert pace.blocks_a_task(left=1000, slots=2) == 1
    pace.blocks, pace.seconds = 10, 1.0  # 0.1 s a block
    assert pace.blocks_a_task(left=1000, slots=2) == 20
    assert pace.blocks_a_task(left=40, slots=2) == 5
    assert pace.blocks_a_task(left=0, slots=2) == 1
    pace.seconds = 1000.0  # 100 s a block
    assert pace.blocks_a_task(left=1000, slots=2) == 1
    pace.learn(answer(5))
    assert pace.blocks == 15 and pace.seconds == 1005.0


def test_the_same_work_has_the_same_key_and_other_work_another():
    job = Job("/store", "id", "1")
    assert task_key(job, [1, 2], 0) == task_key(Job("/store", "id", "1"), [1, 2], 0)
    others = [
        task_key(job, [1, 3], 0),
        task_key(job, [1, 2], 1),
        task_key(job, [1, 2], 0, copy=1),
        task_key(Job("/other", "id", "1"), [1, 2], 0),
        task_key(Job("/store", "other", "1"), [1, 2], 0),
        task_key(Job("/store", "id", "2"), [1, 2], 0),
    ]
    assert len({task_key(job, [1, 2], 0), *others}) == 7


def test_an_answer_lost_with_its_worker_whose_second_run_fails_is_a_failure_of_its_blocks():
    """A future may be finished when it is looked at, and failed when its result is asked for."""

    class Lost:
        key, status = "lost", "finished"

        def result(self, timeout):
            raise RuntimeError("killed")

    todo = Todo(np.zeros(8, dtype=bool))
    window = Window(None, 0, Job("x.zarr", "0", "0"), todo, seen=None, say=None)
    window._flying["lost"] = _Task([3, 4], {"lost": Lost()})
    window._arrived.put(Lost())
    answer = window._next()
    assert [failure.block for failure in answer.failures] == [3, 4] and not answer.receipts
    assert all(failure.error.startswith("RuntimeError") for failure in answer.failures)
