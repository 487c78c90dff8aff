"""The panel beside the scene: states and reasons of the arms, figures of the loop, joints against their limits."""

from __future__ import annotations

import time
from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
import viser

from q2r2_control.events import Event
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.live import next_press, why
from q2r2_control.viewer.web.driving import Driving
from q2r2_control.viewer.web.exchange import Frame, PageRequest, PageSetup
from q2r2_control.viewer.web.scene import AMBER, GREEN, RED, state_colour

_PERIOD = 0.2  # of the table [s]
_NEAR_LIMIT = 0.05  # of a joint's range
_STYLE = "font-size:12px;line-height:1.35;padding:0 0.6em 0.4em"


class Panel:
    """Shows frames, and answers with what the buttons ask for."""

    def __init__(
        self, server: viser.ViserServer, setup: PageSetup, driving: Driving | None, answer: Callable[[Any], None]
    ) -> None:
        self._setup, self._driving, self._bindings = setup, driving, setup.config.teleop.bindings
        self._names = {arm: [setup.joint_names[index] for index in joints] for arm, joints in setup.joints.items()}
        self._last: dict[str, Event] = {}  # of each arm
        self._binding: dict[ActiveLimit, None] = {}
        self._ticks = 0
        self._shown = time.monotonic()
        server.gui.set_panel_label(setup.title)
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(60, 120, 216))
        server.gui.main_panel.dock_right()
        self._add_buttons(server.gui, answer)
        self._table = server.gui.add_html("")

    def _add_buttons(self, gui: viser.GuiApi, answer: Callable[[Any], None]) -> None:
        buttons = [
            ("Stop: rest, and end the run", PageRequest.STOP, "red"),
            ("Pause both arms", PageRequest.PAUSE, "orange"),
            ("Bring both arms home", PageRequest.HOME, "blue"),
        ]
        if self._setup.recorded:
            buttons += [
                ("Begin or end an episode", PageRequest.RECORD, "gray"),
                ("Mark this moment", PageRequest.MARK, "gray"),
            ]
        if self._driving is not None:
            self._driving.add_buttons(gui)
        for label, request, colour in buttons:

            def ask(_: object, request: PageRequest = request) -> None:
                answer(request)

            gui.add_button(label, color=colour).on_click(ask)

    def follow(self, frame: Frame) -> None:
        """Keep what a frame says that may be shown later."""
        self._last |= {event.arm: event for event in frame.events}
        self._binding |= dict.fromkeys(frame.binding)
        self._ticks += frame.ticks

    def show(self, frame: Frame) -> None:
        """Draw the table, some times a second."""
        passed = time.monotonic() - self._shown
        if passed >= _PERIOD:
            self._shown += passed
            ticks, self._ticks = self._ticks, 0
            binding, self._binding = list(self._binding), {}
            self._table.content = self._drawn(frame, ticks / passed, binding)

    def _drawn(self, frame: Frame, rate: float, binding: list[ActiveLimit]) -> str:
        tick, arms = frame.tick, list(frame.tick.tools)
        rows = [
            ("", [f"<b>{escape(arm)}</b>" for arm in arms]),
            ("state", [_coloured(tick.states[arm], state_colour(tick.states[arm])) for arm in arms]),
            ("why", [escape(why(tick, arm, self._names[arm], binding, self._last.get(arm))) for arm in arms]),
            ("next press", [escape(next_press(tick, arm, self._bindings)) for arm in arms]),
            ("off its target", [_distance(tick.tracking_error(arm)[0]) for arm in arms]),
            ("tool [m]", ["{:.3f} {:.3f} {:.3f}".format(*tick.tools[arm].translation) for arm in arms]),
            ("gripper", [_share(tick.grippers.get(arm)) for arm in arms]),
            ("joints", [self._bars(frame, arm) for arm in arms]),
        ]
        if tick.sessions:
            rows.insert(1, ("cabinet", [escape(tick.sessions[arm]) for arm in arms]))
        report = tick.reference.report
        certified = _coloured("certified", GREEN) if report.certified else _coloured("not certified", RED)
        lines = [
            f"{tick.t:.1f} s, {rate:.0f} Hz, {1e6 * tick.compute_time:.0f} us a tick",
            f"tightest pair: {escape(' | '.join(report.tightest_pair))}",
            f"a stop is {certified}; status {escape(str(report.status))}",
        ]
        if self._driving is not None:
            lines.insert(0, escape(self._driving.words))
        cells = "".join(
            f"<tr><td style='color:#777;padding-right:0.6em;vertical-align:top'>{name}</td>"
            + "".join(f"<td style='width:45%;vertical-align:top'>{value}</td>" for value in values)
            + "</tr>"
            for name, values in rows
        )
        return f"<div style='{_STYLE}'><table style='width:100%'>{cells}</table>{'<br>'.join(lines)}</div>"

    def _bars(self, frame: Frame, arm: str) -> str:
        joints, setup = self._setup.joints[arm], self._setup
        q, lower, upper = frame.tick.state.q[joints], setup.lower[joints], setup.upper[joints]
        shares = np.clip((q - lower) / (upper - lower), 0.0, 1.0)
        return "".join(
            "<div style='background:#8883;height:5px;margin:3px 0;border-radius:3px;position:relative'>"
            f"<div style='position:absolute;left:{96.0 * share:.0f}%;width:4%;height:5px;border-radius:3px;"
            f"background:rgb{AMBER if min(share, 1.0 - share) < _NEAR_LIMIT else (120, 130, 140)}'></div></div>"
            for share in shares
        )


def _coloured(text: str, colour: tuple[int, int, int]) -> str:
    return f"<b style='color:rgb{colour}'>{escape(text)}</b>"


def _distance(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm" if np.isfinite(metres) else "-"


def _share(opening: float | None) -> str:
    return "-" if opening is None else f"{100.0 * opening:.0f} % open"
