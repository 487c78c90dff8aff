"""Requests of a program to a run: each is done at the next tick."""

from __future__ import annotations

from q2r2_control.config.bindings import Action
from q2r2_control.events import ReasonKind
from tests.pipeline.loops import pipeline, when_moving
from tests.support.processes import changes


def test_a_pause_holds_both_arms_until_a_new_press() -> None:
    loop = pipeline()
    loop.listeners.append(when_moving(loop.pause))
    summary = loop.run(3.0, realtime=False)
    for arm in ("left", "right"):
        assert changes(list(summary.events), arm)[-1] == ("engaged", "lost", "pause_requested")
    assert summary.at_rest


def test_a_mark_without_a_recording_is_refused() -> None:
    loop = pipeline()
    loop.listeners.append(when_moving(lambda: loop.mark(Action.RECORD_MARK)))
    kinds = [event.kind for event in loop.run(2.5, realtime=False).events if event.arm == "left"]
    assert kinds[-2:] == [ReasonKind.RECORDING_REQUESTED, ReasonKind.NO_RECORDING]
