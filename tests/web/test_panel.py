"""What the panel of the page shows, in which order and in which words, and what it leaves out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest
import viser

from q2r2_control.events import Event, Reason
from q2r2_control.inputs.web import WebInput, web_cell
from q2r2_control.robot.robot import Robot
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.web import panel as panel_module
from q2r2_control.viewer.web.driving import Driving
from q2r2_control.viewer.web.exchange import Frame, PageRequest, PageSetup
from q2r2_control.viewer.web.panel import Panel
from tests.support.page_client import PageClient
from tests.support.processes import cell
from tests.viewer.conftest import tick_at


class Shown:
    """The panel of a run in which the page moves the arms, and a client that receives this panel as a browser does.

    The fixture :func:`shown` lets the panel show every frame, although it usually skips frames that follow too soon.
    """

    def __init__(self, robot: Robot, server: viser.ViserServer) -> None:
        self._robot = robot
        config = web_cell(cell())
        setup = PageSetup(
            **vars(ShownRobot.of(robot, config)),
            host="127.0.0.1",
            port=0,
            addresses=(),
            certificate=None,
            title="cell",
            tools={arm: its.frame_id for arm, its in robot.arms.items()},
            home=robot.home,
            lower=robot.position_lower,
            upper=robot.position_upper,
            model=robot.model,
            collision_model=robot.collision_model,
            parts={},
            requests=(PageRequest.PAUSE,),
            changes=(),
            device=WebInput.controls.words,
            driven=True,
            replayed=False,
        )
        self.cameras = list(config.cameras)
        driving = Driving(server, setup, lambda _: None)
        self._panel = Panel(server, setup, driving, lambda _: None, lambda *_: None)
        self.page = PageClient(f"http://127.0.0.1:{server.get_port()}")

    def show(self, *events: Event, ages: Mapping[str, float] = {}, pictures: Mapping[str, bytes] = {}) -> None:
        frame = Frame(tick_at(self._robot, 1.0, engaged=False), events, (), 1, 0.0, None, ages=ages, pictures=pictures)
        for event in events:
            frame.tick.states[event.arm] = event.destination
        self._panel.follow(frame)
        self._panel.show(frame)


@pytest.fixture
def shown(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shown]:
    monkeypatch.setattr(panel_module, "_PERIOD", 0.0)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    made = Shown(robot, server)
    with made.page:
        yield made
    server.stop()


def test_pictures_of_cameras_are_shown_in_the_order_of_the_cell_whichever_comes_first(shown: Shown) -> None:
    assert len(shown.cameras) > 1
    for name in reversed(shown.cameras):
        shown.show(pictures={name: b"picture"})
    shown.page.wait_until(lambda: all(name in shown.page.words for name in shown.cameras))
    places = [shown.page.words.index(name) for name in shown.cameras]
    assert places == sorted(places)


def test_buttons_of_grippers_are_above_the_pictures_of_cameras(shown: Shown) -> None:
    shown.show(pictures={shown.cameras[0]: b"picture"})
    shown.page.wait_until(lambda: shown.cameras[0] in shown.page.words)
    shown.page.button("left: close or open the gripper")
    assert shown.page.order_of("Grippers") < shown.page.order_of(shown.cameras[0])


def test_advice_and_buttons_of_grippers_stand_above_the_table(shown: Shown) -> None:
    """A small window shows only the top of the panel."""
    shown.show(Event(0.9, "left", "engaged", "lost", Reason.of(TeleopReason.POSE_SILENT, timeout=0.15)))
    advice = "The positions of the dragged tool came too late."
    shown.page.wait_until(lambda: shown.page.says(advice))
    assert shown.page.order_of("Grippers") < shown.page.order_of(advice) < shown.page.order_of("tightest pair")


def test_the_first_page_has_the_number_1(shown: Shown) -> None:
    shown.page.wait_until(lambda: shown.page.says("this is page "))
    assert shown.page.says("this is page 1")


def test_the_age_of_a_hands_newest_pose_is_blank_if_no_pose_has_come_for_a_long_time(shown: Shown) -> None:
    shown.show(ages={"left": 0.012})
    shown.page.wait_until(lambda: shown.page.row("hand's age") == ["12 ms", ""])
    shown.show(ages={"left": 36.9, "right": 1.5})
    shown.page.wait_until(lambda: shown.page.row("hand's age") == ["", "1500 ms"])


def test_the_panel_shows_the_cure_beside_an_arm_that_is_lost_because_poses_are_missing(shown: Shown) -> None:
    shown.show()
    shown.page.wait_until(lambda: shown.page.row("state") == ["paused", "paused"])
    assert not shown.page.says("too late")
    silent = Reason.of(TeleopReason.POSE_SILENT, timeout=0.15)
    shown.show(Event(0.9, "left", "engaged", "lost", silent))
    shown.page.wait_until(lambda: shown.page.row("state")[0] == "lost")
    assert shown.page.says("The positions of the dragged tool came too late. Let go, then drag again.")
    shown.show(Event(1.0, "left", "lost", "engaged", Reason(TeleopReason.DEAD_MAN_HELD)))
    shown.page.wait_until(lambda: shown.page.row("state")[0] == "engaged")
    assert not shown.page.says("too late")
