"""A process beside the loop never keeps the run from ending, and neither do the children of that process."""

from __future__ import annotations

import pytest

from q2r2_control.process.helper_process import HelperProcess
from tests.support.processes import alive, wait_until


@pytest.mark.parametrize(("busy", "fault"), [(False, "did nothing for 0.5 s"), (True, "did not end within 0.5 s")])
def test_a_process_that_does_not_end_is_killed_with_its_children(busy: bool, fault: str) -> None:
    started: list[int] = []
    process = HelperProcess("lasts", "tests.support.lasting_helper", started.append)
    process.send(busy)
    wait_until(lambda: started)
    process.finish(patience=60.0 if busy else 0.5, longest=0.5 if busy else 60.0)
    assert process.fault == f"the process that lasts {fault}"
    wait_until(lambda: not alive(started[0]) and not process.alive)


def test_a_process_whose_answer_cannot_be_used_is_ended_with_its_children_and_the_fault_says_why() -> None:
    started: list[int] = []

    def refuse(child: int) -> None:
        started.append(child)
        raise ValueError("the page\nis closed")

    process = HelperProcess("lasts", "tests.support.lasting_helper", refuse)
    process.send(False)
    wait_until(lambda: not process.alive)
    assert process.fault == "an answer of the process that lasts was refused: the page is closed"
    wait_until(lambda: not alive(started[0]))
