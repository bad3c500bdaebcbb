"""How many blocks a task has: by their time, the number of workers, and what is left."""

from sweep.tasks.window import MOST_BLOCKS, TASK_SECONDS, TASKS_A_SECOND, Pace, Slots


def pace(seconds_a_block: float) -> Pace:
    return Pace(blocks=100, seconds=100 * seconds_a_block)


def test_the_first_tasks_have_a_block_each():
    assert Pace().blocks_a_task(10**6, 2) == 1


def test_tasks_take_their_time_on_few_workers():
    assert pace(0.1).blocks_a_task(10**6, 2) == TASK_SECONDS / 0.1
    assert pace(30.0).blocks_a_task(10**6, 2) == 1
    assert pace(1e-6).blocks_a_task(10**9, 2) == MOST_BLOCKS


def test_thousands_of_workers_never_ask_more_of_the_scheduler_than_it_can_do():
    for slots in (100, 1000, 10_000):
        blocks = pace(0.1).blocks_a_task(10**9, slots)
        tasks_a_second = slots / (blocks * 0.1)
        assert tasks_a_second <= TASKS_A_SECOND * 1.01


def test_tasks_grow_short_towards_the_end():
    assert pace(0.1).blocks_a_task(80, 10) == 2
    assert pace(0.1).blocks_a_task(3, 10) == 1


class Client:
    """A scheduler with two workers."""

    def nthreads(self):
        return {"tcp://a": 1, "tcp://b": 1}


def test_workers_that_may_come_are_counted_so_that_their_coming_is_asked_for():
    assert Slots(Client()).now() == 2
    assert Slots(Client(), hoped=40).now() == 40
    assert Slots(Client(), hoped=1).now() == 2
