"""Slow down the clocks of every Python process whose path has this folder: one second takes ``SLOWNESS`` real seconds.

A busy computer then has ``SLOWNESS`` times as much real time for each tick of a loop and for each answer. Everything
else is as with real clocks.
"""

from __future__ import annotations

import os
import time

_SLOWNESS = float(os.environ.get("SLOWNESS", "1"))
if _SLOWNESS != 1.0:
    _sleep, _perf_counter, _monotonic = time.sleep, time.perf_counter, time.monotonic
    time.sleep = lambda duration: _sleep(_SLOWNESS * float(duration))
    time.perf_counter = lambda: _perf_counter() / _SLOWNESS
    time.monotonic = lambda: _monotonic() / _SLOWNESS
