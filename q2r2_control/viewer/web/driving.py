"""Gizmos at the tools: arrows and rings. One page at a time moves the tools by dragging them, in place of a hand."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import RLock, Thread
from typing import Any

import pinocchio as pin
import viser

from q2r2_control.events import Event
from q2r2_control.teleop.arm_states import HOLDING, ArmState
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.viewer.web.exchange import Frame, PageHand, PageLost, PageSetup
from q2r2_control.viewer.web.figure import place
from q2r2_control.viewer.web.pace import BrowserPace

_SIZE = 0.22  # Size of a gizmo [m].
_PERIOD = 0.02  # Shortest time between two samples of a dragged hand [s].
_ANSWER = 60.0  # A page that gives no answer for this time stops driving [s]. Long before, the gate stops the arms.
_Gizmos = dict[str, viser.TransformControlsHandle]  # The gizmo of each arm.


class Driving:
    """Lets pages drag the tools. The page that drags first drives until it releases its tools.

    Until then the other pages only watch, and show no gizmos. A browser sends nothing while the mouse rests. Therefore
    the page that drives is asked again and again for an answer, which its script gives. At each answer, a sample of
    each dragged hand is sent. Without answers, the teleop layer's gate stops the arms.
    """

    def __init__(self, server: viser.ViserServer, setup: PageSetup, answer: Callable[[Any], None]) -> None:
        self._server, self._arms, self._answer = server, tuple(setup.joints), answer
        self._pace = BrowserPace(setup.config.teleop.gate.timeout)
        self._lock = RLock()
        self._gizmos: dict[int, tuple[viser.ClientHandle, _Gizmos]] = {}  # For each page: connection and gizmos.
        self._driver: int | None = None  # The page that drives; None if no page drives.
        # For each dragged arm, the pose of the gizmo in the world frame: position [m] and quaternion x y z w.
        self._dragged: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {}
        self._spent: set[str] = set()  # Arms whose last drag cannot engage them any more.
        self._gizmo_count = 0
        self._tools: dict[str, tuple[float, ...]] = {}  # Tool poses x y z [m] qx qy qz qw (world frame).
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    @property
    def words(self) -> str:
        """The page that drives, in words; instructions if no page drives."""
        driver = self._driver
        return "drag a tool's arrows or rings to move it" if driver is None else f"page {driver + 1} drives"

    def next_step(self, arm: str, moves: bool) -> str:
        """Return what to do next with an arm that is dragged but does not move; empty for other arms."""
        return "let go, then drag again to engage" if not moves and arm in {*self._dragged, *self._spent} else ""

    def slowness(self, silent: bool) -> str:
        """Return why the hand poses of the page that drives come too late; see :meth:`BrowserPace.advice`."""
        return self._pace.advice(silent)

    def add_buttons(self, gui: viser.GuiApi) -> None:
        """Add a button for each gripper."""
        for arm in self._arms:

            @gui.add_button(f"{arm}: close or open the gripper").on_click
            def _(event: viser.GuiEvent, arm: str = arm) -> None:
                with self._lock:
                    if self._driver in (None, event.client_id):
                        for pressed in (False, True, False):
                            self._send(arm, pressed)

    def follow(self, frame: Frame) -> None:
        """End each drag whose arm has stopped or was refused, because only a new drag can engage the arm."""
        with self._lock:
            for arm in {event.arm for event in frame.events if _ends_drag(event)} & self._dragged.keys():
                self._send(arm, drag=False)
                self._spent.add(arm)
                self._replace_gizmo(arm)
                self._forget_drag(arm)

    def show(self, frame: Frame) -> None:
        """Move all gizmos that nobody drags to the poses of their tools."""
        with self._lock:
            self._tools = {arm: tuple(pin.SE3ToXYZQUATtuple(tool)) for arm, tool in frame.tick.tools.items()}
            for page, (_, gizmos) in self._gizmos.items():
                for arm, gizmo in gizmos.items():
                    gizmo.visible = self._driver in (None, page)
                    if self._driver != page or arm not in self._dragged:
                        place(gizmo, frame.tick.tools[arm])

    async def _connect(self, client: viser.ClientHandle) -> None:
        page, gizmos = client.client_id, _Gizmos()
        client.gui.add_html(f"<div style='font-size:12px;padding:0 0.6em'>this is page {page + 1}</div>")
        with self._lock:
            for arm in self._arms:
                gizmos[arm] = self._add_gizmo(client, arm)
            self._gizmos[page] = client, gizmos

    def _add_gizmo(self, client: viser.ClientHandle, arm: str) -> viser.TransformControlsHandle:
        # Each gizmo gets a new name, because a browser would go on with the drag of an earlier gizmo that had the same
        # name.
        self._gizmo_count += 1
        name = f"/gizmos/{arm}_{self._gizmo_count}"
        gizmo = client.scene.add_transform_controls(name, scale=_SIZE, depth_test=False, visible=False)

        async def drag(event: viser.TransformControlsEvent) -> None:
            # This function must not await anything. Otherwise, a later event could already have changed the pose.
            self._drag(client.client_id, arm, event)

        gizmo.on_update(drag)
        return gizmo

    def _replace_gizmo(self, arm: str) -> None:
        """Replace the gizmo of a dragged arm by a new gizmo, which ends the drag in the browser."""
        if self._driver is not None:
            client, gizmos = self._gizmos[self._driver]
            gizmos[arm].remove()
            gizmos[arm] = self._add_gizmo(client, arm)

    async def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._gizmos.pop(client.client_id, None)
            if self._driver == client.client_id:
                self._lose()

    def _drag(self, page: int, arm: str, event: viser.TransformControlsEvent) -> None:
        with self._lock:
            if event.phase == "start" and self._driver in (None, page):
                begins, self._driver = self._driver is None, page
                self._dragged[arm] = _pose_of(event.target)
                self._spent.discard(arm)
                for held in (False, True):  # A press counts only if the control was released before.
                    self._send(arm, drag=held)
                if begins:
                    self._pace.begin()
                    Thread(target=self._ask, args=(page,), daemon=True).start()
            elif self._driver == page and event.phase == "end" and page not in self._server.get_clients():
                self._lose()  # The page has gone, so viser has ended its drag.
            elif self._driver == page and arm in self._dragged:
                self._dragged[arm] = _pose_of(event.target)
                self._send(arm, drag=event.phase != "end")
                if event.phase == "end":
                    self._forget_drag(arm)

    def _forget_drag(self, arm: str) -> None:
        del self._dragged[arm]
        if not self._dragged:
            self._driver = None
            self._pace.end()

    def _ask(self, page: int) -> None:
        """Ask the page that drives for answers, until it no longer drives. At each answer, samples are sent."""
        while True:
            with self._lock:
                if self._driver != page:
                    return
                client, _ = self._gizmos[page]
            began = time.monotonic()
            try:
                client.local_storage.get_item("alive", timeout=_ANSWER)
            except (RuntimeError, TimeoutError):
                with self._lock:
                    if self._driver == page:
                        self._lose()
                return
            with self._lock:
                if self._driver == page:
                    self._pace.note()
                for arm in self._dragged if self._driver == page else ():
                    self._send(arm)
            time.sleep(max(began + _PERIOD - time.monotonic(), 0.0))

    def _lose(self) -> None:
        self._driver = None
        self._pace.end()
        self._dragged.clear()
        self._answer(PageLost())

    def _send(self, arm: str, gripper: bool = False, drag: bool | None = None) -> None:
        held = arm in self._dragged
        if not held and arm not in self._tools:
            return
        position, quaternion = self._dragged[arm] if held else (self._tools[arm][:3], self._tools[arm][3:])
        self._answer(PageHand(arm, position, quaternion, held if drag is None else drag, gripper))


def _ends_drag(event: Event) -> bool:
    """Return whether the present drag of the event's arm cannot engage the arm any more."""
    if event.kind is TeleopReason.NOT_ENGAGED:
        return True
    stops = event.source != event.destination and event.destination in HOLDING | {ArmState.HOMING}
    # A release does not count, because it is the end of an earlier drag.
    return stops and event.kind is not TeleopReason.DEAD_MAN_RELEASED


def _pose_of(gizmo: viser.TransformControlsHandle) -> tuple[tuple[float, ...], tuple[float, ...]]:
    w, *xyz = map(float, gizmo.wxyz)
    return tuple(map(float, gizmo.position)), (*xyz, w)
