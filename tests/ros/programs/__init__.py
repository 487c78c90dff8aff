"""Programs that tests start as processes of their own: ``python -m tests.ros.programs.<name>``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Spin in here: Ctrl-C ends it without an error, at whichever point of rclpy it comes."""
    try:
        yield
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:  # a wait begun after rclpy's own handler has ended the context
        if rclpy.ok():
            raise
