"""The worker keeps order, drops the oldest and survives bad items; threadless it is immediate."""

import threading

from lcd_common.nodes.worker import Worker


def make(work, *, capacity: int = 2, threaded: bool = True):
    dropped: list[int] = []
    errors: list[Exception] = []
    worker = Worker(
        work,
        capacity=capacity,
        threaded=threaded,
        on_drop=dropped.append,
        on_error=errors.append,
        name='test',
    )
    return worker, dropped, errors


def test_the_oldest_waiting_item_is_dropped_and_counted() -> None:
    started, go, done = threading.Event(), threading.Event(), threading.Event()
    seen: list[int] = []

    def work(item: int) -> None:
        started.set()
        assert go.wait(5.0)
        seen.append(item)
        if item == 4:
            done.set()

    worker, dropped, errors = make(work)
    worker.put(0)
    assert started.wait(5.0)
    for item in (1, 2, 3, 4):
        worker.put(item)
    assert dropped == [1, 2]
    assert worker.waiting() == 2 and not worker.idle()
    go.set()
    assert done.wait(5.0)
    worker.stop()
    assert seen == [0, 3, 4]
    assert not errors and worker.idle()


def test_without_a_thread_put_returns_when_the_work_is_done() -> None:
    seen: list[int] = []
    worker, dropped, _ = make(seen.append, threaded=False)
    for item in range(5):
        worker.put(item)
        assert seen[-1] == item
    assert not dropped and worker.idle()
    worker.stop()


def test_a_bad_item_does_not_stop_the_worker() -> None:
    done = threading.Event()

    def work(item: int) -> None:
        if item == 0:
            raise ValueError('bad')
        done.set()

    worker, _, errors = make(work)
    worker.put(0)
    worker.put(1)
    assert done.wait(5.0)
    worker.stop()
    assert [str(error) for error in errors] == ['bad']


def test_clear_forgets_what_waits() -> None:
    started, go = threading.Event(), threading.Event()
    seen: list[int] = []

    def work(item: int) -> None:
        started.set()
        assert go.wait(5.0)
        seen.append(item)

    worker, _, _ = make(work)
    worker.put(0)
    assert started.wait(5.0)
    worker.put(1)
    worker.clear()
    go.set()
    worker.stop()
    assert seen == [0]
