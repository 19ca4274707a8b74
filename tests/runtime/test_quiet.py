"""OpenCV's log is silent while any block wants it, and as before afterwards, whatever threads the blocks ran in."""

from __future__ import annotations

import threading

from runtime.quiet import _log, quiet_opencv


def test_blocks_of_two_threads_that_end_in_the_order_they_began() -> None:
    before = _log.getLogLevel()
    inside, leave = threading.Event(), threading.Event()
    levels = []

    def first() -> None:
        with quiet_opencv():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=first)
    thread.start()
    assert inside.wait(10)
    with quiet_opencv():
        leave.set()
        thread.join()
        levels.append(_log.getLogLevel())
    levels.append(_log.getLogLevel())
    assert levels == [0, before]
    assert before > 0
