"""The thread that draws a page writes messages while the server's thread waits for them."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor

from q2r2_control.viewer.web.message_buffer import LoopEvent


class Guarded(deque[object]):
    """The waiters of an event. Only the thread that made them may go through them."""

    def __init__(self) -> None:
        super().__init__()
        self._owner = threading.get_ident()

    def __iter__(self):  # type: ignore[no-untyped-def]
        assert threading.get_ident() == self._owner, "another thread goes through the waiters of the loop"
        return super().__iter__()


def test_another_thread_marks_the_event_and_only_the_loop_wakes_its_waiters() -> None:
    async def wait() -> list[bool]:
        event = LoopEvent()
        event._waiters = Guarded()  # type: ignore[assignment]
        waiter = asyncio.ensure_future(event.wait())
        await asyncio.sleep(0)
        await asyncio.get_running_loop().run_in_executor(None, event.set)
        marked = [event.is_set(), waiter.done()]
        event.set()
        return [*marked, await asyncio.wait_for(waiter, 60.0)]

    # Tests with a browser leave a running loop in this thread, so this loop gets a thread of its own.
    with ThreadPoolExecutor(1) as own:
        assert own.submit(asyncio.run, wait()).result() == [True, False, True]
