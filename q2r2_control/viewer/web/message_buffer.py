"""The buffer of messages to browsers. It is viser's buffer, but other threads than the server's may write into it."""

from __future__ import annotations

import asyncio
from typing import Any

from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer


class LoopEvent(asyncio.Event):
    """An event whose waiters are woken only in the thread of their loop.

    viser sets the event of a new message twice: at once, in the thread that writes the message, and then in the
    thread of the loop. In the first call, ``asyncio.Event.set`` would go through the waiters while the loop may change
    them, and raise a RuntimeError. Here the first call only marks the event as set, and the second call wakes the
    waiters.
    """

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # This is not the thread of the loop.
            self._value = True
            return
        self._value = False  # A set event would not wake its waiters.
        super().set()


class MessageBuffer(AsyncMessageBuffer):
    """viser's buffer of messages. Its event is a :class:`LoopEvent`."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings, message_event=LoopEvent())


def use_message_buffer() -> None:
    """Let all servers of viser that are started later in this process use :class:`MessageBuffer`."""
    _infra.AsyncMessageBuffer = MessageBuffer
