"""The thread pool: fixed chunks, order, errors, nesting, forks."""

import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from epipole import _parallel
from epipole._parallel import (
    available_cpus,
    chunk_bounds,
    inline_here,
    map_chunks,
    map_items,
    num_threads,
    set_num_threads,
    single_threaded_blas,
)


@pytest.fixture(autouse=True)
def default_threads() -> Iterator[None]:
    yield
    set_num_threads(None)


@pytest.mark.parametrize("num_items", [0, 1, 2, 15, 16, 17, 1000])
@pytest.mark.parametrize("num_chunks", [0, 1, 16, 40])
def test_chunks_cover_the_items_once_and_evenly(num_items: int, num_chunks: int) -> None:
    bounds = chunk_bounds(num_items, num_chunks)
    assert [i for start, stop in bounds for i in range(start, stop)] == list(range(num_items))
    sizes = {stop - start for start, stop in bounds}
    assert len(bounds) <= max(1, num_chunks) and (not sizes or max(sizes) - min(sizes) <= 1)
    assert 0 not in sizes


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order_and_chunks_do_not_depend_on_threads(threads: int) -> None:
    set_num_threads(threads)
    assert num_threads() == threads
    found = map_chunks(lambda start, stop, chunk: (chunk, start, stop), 100, 7)
    assert found == [(c, *bounds) for c, bounds in enumerate(chunk_bounds(100, 7))]
    assert map_items(lambda i: i * i, 50) == [i * i for i in range(50)]
    assert map_items(lambda i: i, 0) == [] and map_items(lambda i: i, 1) == [0]


def test_sums_are_the_same_bits_for_any_number_of_threads(rng: np.random.Generator) -> None:
    values = rng.normal(size=100_003) * 10.0 ** rng.integers(-8, 8, 100_003)

    def total(threads: int) -> float:
        set_num_threads(threads)
        return sum(map_chunks(lambda start, stop, _: float(values[start:stop].sum()), len(values)))

    assert len({total(threads) for threads in (1, 2, 3, 8)}) == 1


def test_chunks_really_run_at_once() -> None:
    set_num_threads(3)
    meeting = threading.Barrier(3, timeout=20)
    assert sorted(map_items(lambda i: meeting.wait() * 0 + i, 3)) == [0, 1, 2]


def test_one_thread_is_the_calling_thread() -> None:
    set_num_threads(1)
    assert set(map_items(lambda _: threading.get_ident(), 5)) == {threading.get_ident()}


def test_work_inside_work_runs_inline() -> None:
    set_num_threads(2)

    def outer(_: int) -> bool:
        inner = map_items(lambda _: threading.get_ident(), 4)
        return set(inner) == {threading.get_ident()}

    assert all(map_items(outer, 8))


def test_a_thread_can_ask_to_run_inline() -> None:
    set_num_threads(2)
    seen: list[set[int]] = []

    def body() -> None:
        with inline_here():
            seen.append({threading.get_ident(), *map_items(lambda _: threading.get_ident(), 4)})

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert len(seen[0]) == 1
    meeting = threading.Barrier(2, timeout=20)
    here = map_items(lambda _: (meeting.wait(), threading.get_ident())[1], 2)
    assert len(set(here)) == 2 and threading.get_ident() in here


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_reaches_the_caller_and_the_pool_lives_on(threads: int) -> None:
    set_num_threads(threads)

    def work(i: int) -> int:
        if i == 3:
            raise KeyError("item 3")
        return i

    with pytest.raises(KeyError, match="item 3"):
        map_items(work, 8)
    assert map_items(lambda i: i, 8) == list(range(8))


def test_after_an_error_nothing_is_begun_and_nothing_still_runs() -> None:
    set_num_threads(2)
    running, started = [0], []

    def work(i: int) -> None:
        running[0] += 1
        started.append(i)
        try:
            if i == 0:
                raise KeyError("item 0")
            time.sleep(0.02)
        finally:
            running[0] -= 1

    with pytest.raises(KeyError, match="item 0"):
        map_items(work, 100)
    assert running[0] == 0
    assert len(started) < 50


def test_the_number_of_threads_is_taken_from_the_surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    for requested, expected in (("3", 3), ("0", 1), ("many", available_cpus()), ("", available_cpus())):
        monkeypatch.setenv("EPIPOLE_NUM_THREADS", requested)
        assert num_threads() == expected
    set_num_threads(2)
    assert num_threads() == 2
    set_num_threads(0)
    assert num_threads() == 1
    set_num_threads(None)
    monkeypatch.delenv("EPIPOLE_NUM_THREADS")
    assert num_threads() == available_cpus() >= 1


def test_processors_are_those_this_process_may_use() -> None:
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system has no processor affinity")
    code = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]);"
        "from epipole._parallel import available_cpus; print(available_cpus())"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout == "1\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_child_has_its_own_pool() -> None:
    set_num_threads(2)
    map_items(lambda i: i, 4)
    assert _parallel._pool is not None
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=lambda: queue.put(map_items(lambda i: 2 * i, 4)), daemon=True)
    child.start()
    child.join(20)
    try:
        assert child.exitcode == 0, "the child hangs on its parent's threads"
    finally:
        child.kill()
    assert queue.get() == [0, 2, 4, 6]


def test_blas_has_one_thread_inside_and_its_own_number_after() -> None:
    def blas_threads() -> list[int]:
        return [int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"]

    with single_threaded_blas():  # the first time loads SciPy's
        pass
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert 2 in before
        with single_threaded_blas():
            assert set(blas_threads()) <= {1}
        assert blas_threads() == before
