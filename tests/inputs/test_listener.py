"""Rates are bounded at any time, and no line of the log is lost without being counted."""

from __future__ import annotations

import logging
import math

from q2r2_control.inputs.listener import MAX_HOSTS_NAMED, HostLog, RateLimit

INFO, WARNING = logging.INFO, logging.WARNING


class Lines(logging.Logger):
    """A logger that keeps its lines."""

    def __init__(self) -> None:
        super().__init__("lines")
        self.lines: list[str] = []

    def handle(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname} {record.getMessage()}")


def test_a_rate_is_kept_in_each_period_and_its_rest_is_lost() -> None:
    limit = RateLimit(3, 0.5)
    assert [limit.take(10.0) for _ in range(5)] == [True, True, True, False, False]
    assert not limit.is_open(10.25)
    assert not limit.take(10.25)
    assert limit.is_open(10.5)
    assert [limit.take(20.0) for _ in range(5)] == [True, True, True, False, False]


def test_the_first_line_of_a_host_is_written_at_once_and_later_ones_once_a_second_with_their_number() -> None:
    lines = Lines()
    log = HostLog(lines)
    for index in range(3000):
        log.write("a", WARNING, f"line {index}", 10.0 + index / 1000.0)
    log.flush(12.9)
    assert lines.lines == [
        "WARNING line 0",
        "WARNING line 999 (998 more left out)",
        "WARNING line 1999 (999 more left out)",
    ]
    log.flush(13.1)
    assert lines.lines[3:] == ["WARNING line 2999 (999 more left out)"]
    log.flush(99.0)
    assert len(lines.lines) == 4


def test_a_single_line_that_came_too_early_is_written_a_little_later_as_it_is() -> None:
    lines = Lines()
    log = HostLog(lines)
    log.write("a", INFO, "connected", 10.0)
    log.write("a", WARNING, "dropped", 10.2)
    log.flush(10.9)
    assert lines.lines == ["INFO connected"]
    log.flush(11.0)
    assert lines.lines == ["INFO connected", "WARNING dropped"]


def test_what_matters_most_is_what_is_kept() -> None:
    lines = Lines()
    log = HostLog(lines)
    for level, text in ((INFO, "connected"), (WARNING, "dropped"), (INFO, "connected")):
        log.write("a", level, text, 10.0)
    log.flush(math.inf)
    assert lines.lines == ["INFO connected", "WARNING dropped (1 more left out)"]


def test_hosts_do_not_silence_each_other_but_beyond_eight_they_share_a_line() -> None:
    lines = Lines()
    log = HostLog(lines)
    for index in range(100):
        log.write(f"host {index}", WARNING, f"line {index}", 10.0)
    assert lines.lines == [f"WARNING line {index}" for index in range(MAX_HOSTS_NAMED + 1)]
    log.flush(math.inf)
    assert lines.lines[MAX_HOSTS_NAMED + 1 :] == ["WARNING line 99 (90 more left out)"]
