"""The panel beside the scene: states and reasons of the arms, figures of the loop, joints against their limits."""

from __future__ import annotations

import time
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from html import escape
from typing import Any

import numpy as np
import pinocchio as pin
import viser

from q2r2_control.events import Event, ReasonKind
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.live import next_press, why
from q2r2_control.viewer.state_colours import AMBER, GREEN, RED, state_colour
from q2r2_control.viewer.web.driving import Driving
from q2r2_control.viewer.web.exchange import (
    Frame,
    PageChange,
    PagePlay,
    PageRequest,
    PageSeek,
    PageSetting,
    PageSetup,
)
from q2r2_control.wording import sentence

_PERIOD = 0.2  # of the table [s]
_HISTORY = 150  # values of the plots
_NEAR_LIMIT = 0.05  # of a joint's range
_EPISODES = 12  # lines of them
_OF_EPISODES = (
    *(ReasonKind.EPISODE_BEGINS, ReasonKind.EPISODE_ENDS, ReasonKind.EPISODE_SUCCEEDED, ReasonKind.EPISODE_FAILED),
    *(ReasonKind.EPISODE_DISCARDED, ReasonKind.MARK, ReasonKind.VERDICT),
)
_BUTTONS = {
    PageRequest.STOP: ("Stop: rest, and end the run", "red"),
    PageRequest.RESET: ("Take a stop back", "gray"),
    PageRequest.ENGAGE: ("Engage both arms", "green"),
    PageRequest.PAUSE: ("Pause both arms", "orange"),
    PageRequest.HOME: ("Bring both arms home", "blue"),
    PageRequest.RECORD: ("Begin or end an episode", "gray"),
    PageRequest.MARK: ("Mark this moment", "gray"),
}
_STYLE = "font-size:12px;line-height:1.35;padding:0 0.6em 0.4em"


class Panel:
    """Shows frames, and answers with what the buttons and sliders ask for."""

    def __init__(
        self,
        server: viser.ViserServer,
        setup: PageSetup,
        driving: Driving | None,
        answer: Callable[[Any], None],
        take_over: Callable[[viser.GuiButtonHandle, Callable[[], None]], None],
    ) -> None:
        """``take_over`` does an action at each press of a button, whatever pages do to viser's widgets."""
        self._setup, self._driving, self._bindings = setup, driving, setup.config.teleop.bindings
        self._answer, self._take_over = answer, take_over
        self._names = {arm: [setup.joint_names[index] for index in joints] for arm, joints in setup.joints.items()}
        self._last: dict[str, Event] = {}  # of each arm
        self._binding: dict[ActiveLimit, None] = {}
        self._told: list[tuple[str, str]] = []  # of episodes, and when
        self._ticks, self._slowest = 0, 0.0
        self._rates, self._times = deque[float](maxlen=_HISTORY), deque[float](maxlen=_HISTORY)  # [Hz], [us]
        self._moved: dict[PageSetting, float] = {}  # sliders
        self._shown = time.monotonic()
        self._drawn_last: tuple[float, Mapping[str, pin.SE3]] = 0.0, {}  # time [s] and tools
        gui = server.gui
        gui.set_panel_label(setup.title)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(60, 120, 216))
        gui.main_panel.dock_right()
        self._time_line: viser.GuiSliderHandle[float] | None = None
        if setup.replayed:
            self._add_time_line(gui)
        else:
            self._add_buttons(gui)
        self._table = gui.add_html("")
        self._episodes = gui.add_html("", visible=False)
        self._cameras = gui.add_html("", visible=False)
        self._pictures: Mapping[str, bytes] = {}  # newest ones by camera
        self._pictured: Mapping[str, bytes] = self._pictures  # those that are shown
        if driving is not None:
            with gui.add_folder("Grippers", expand_by_default=False):
                driving.add_buttons(gui)
        if setup.changes and not setup.replayed:
            self._add_settings(gui)
        if not setup.replayed:
            with gui.add_folder("Controls of a hand", expand_by_default=False):
                gui.add_html(_table(self._bindings.meanings().items()))

    def _add_settings(self, gui: viser.GuiApi) -> None:
        ratio, scale = self._setup.config.impedance.damping_ratio, self._setup.config.teleop.position_scale
        sliders = {
            PageSetting.SPEED: ("speed [%]", (5.0, 100.0, 5.0, 100.0), 0.01),
            PageSetting.STIFFNESS: ("stiffness [%]", (10.0, 100.0, 5.0, 100.0), 0.01),
            PageSetting.DAMPING: ("damping ratio", (0.3, 2.0, 0.05, ratio), 1.0),
            PageSetting.SCALE: ("hand scale", (0.1, max(2.0, scale), 0.05, scale), 1.0),
        }
        with gui.add_folder("Settings", expand_by_default=False):
            for setting in self._setup.changes:
                label, numbers, unit = sliders[setting]
                self._add_slider(gui, label, setting, numbers, unit)

    def _add_buttons(self, gui: viser.GuiApi) -> None:
        for request in self._setup.requests:
            label, colour = _BUTTONS[request]
            if request is PageRequest.STOP and PageRequest.RESET in self._setup.requests:
                label = "Stop: rest, until that is taken back"

            def ask(_: object, request: PageRequest = request) -> None:
                self._answer(request)

            button = gui.add_button(label, color=colour)
            if request is PageRequest.STOP:
                self._take_over(button, partial(self._answer, request))
            else:
                button.on_click(ask)

    def _add_time_line(self, gui: viser.GuiApi) -> None:
        gui.add_button("Play, or stand still", color="blue").on_click(lambda _: self._answer(PagePlay()))
        self._time_line = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)

        def seek(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client_id is not None:  # no page has moved it otherwise
                self._answer(PageSeek(float(event.target.value)))

        self._time_line.on_update(seek)
        end = gui.add_button("End the replay", color="red")
        self._take_over(end, partial(self._answer, PageRequest.STOP))

    def _add_slider(
        self,
        gui: viser.GuiApi,
        label: str,
        setting: PageSetting,
        numbers: tuple[float, float, float, float],
        unit: float,
    ) -> None:
        """``numbers``: least, greatest, step and first value, in ``unit`` of the setting."""
        slider = gui.add_slider(label, *numbers)

        def move(_: object) -> None:
            self._moved[setting] = unit * min(max(float(slider.value), numbers[0]), numbers[1])

        slider.on_update(move)

    def follow(self, frame: Frame) -> None:
        """Keep what a frame says that may be shown later."""
        self._last |= {event.arm: event for event in frame.events}
        for event in frame.events:
            line = f"{event.t:.1f} s", sentence(event.reason)
            if event.kind in _OF_EPISODES and line not in self._told[-2:]:  # both arms tell it
                self._told.append(line)
        self._binding |= dict.fromkeys(frame.binding)
        if frame.pictures:
            self._pictures = {**self._pictures, **frame.pictures}
        self._ticks += frame.ticks
        self._slowest = max(self._slowest, frame.slowest)

    def show(self, frame: Frame) -> None:
        """Draw the table, and pass on where sliders are, some times a second."""
        passed = time.monotonic() - self._shown
        if passed >= _PERIOD:
            self._shown += passed
            ticks, self._ticks = self._ticks, 0
            slowest, self._slowest = self._slowest, 0.0
            self._rates.append(ticks / passed)
            self._times.append(1e6 * slowest)
            binding, self._binding = list(self._binding), {}
            self._table.content = self._drawn(frame, binding)
            if self._told and not self._setup.replayed:  # of a replay, each frame has the last events
                self._episodes.content, self._episodes.visible = _table(self._told[-_EPISODES:]), True
            if (pictures := self._pictures) is not self._pictured:
                self._pictured, self._cameras.visible = pictures, True
                self._cameras.content = "".join(_image(name, picture) for name, picture in pictures.items())
            if (line := self._time_line) is not None and frame.tick.t != line.value:
                line.max = max(frame.end, line.max)
                line.value = frame.tick.t
            moved, self._moved = self._moved, {}
            for setting, value in moved.items():
                self._answer(PageChange(setting, value))

    def _drawn(self, frame: Frame, binding: list[ActiveLimit]) -> str:
        tick, arms = frame.tick, list(frame.tick.tools)
        rows = [
            ("", [f"<b>{escape(arm)}</b>" for arm in arms]),
            ("state", [_coloured(tick.states[arm], state_colour(tick.states[arm])) for arm in arms]),
            ("why", [escape(self._why(frame, arm, binding)) for arm in arms]),
            ("next press", [escape(next_press(tick, arm, self._bindings)) for arm in arms]),
            ("off its target", [_distance(tick.tracking_error(arm)[0]) for arm in arms]),
            ("hand's age", [_milliseconds(frame.ages.get(arm)) for arm in arms]),
            ("tool speed [m/s]", [self._tool_speed(tick, arm) for arm in arms]),
            ("tool [m]", ["{:.3f} {:.3f} {:.3f}".format(*tick.tools[arm].translation) for arm in arms]),
            ("gripper", [_share(tick.grippers.get(arm)) for arm in arms]),
            ("joints", [self._bars(frame, arm) for arm in arms]),
        ]
        if tick.sessions:
            rows.insert(1, ("cabinet", [escape(tick.sessions[arm]) for arm in arms]))
        self._drawn_last = tick.t, tick.tools
        report = tick.reference.report
        certified = _coloured("certified", GREEN) if report.certified else _coloured("not certified", RED)
        lines = [
            f"{tick.t:.1f} s",
            f"tightest pair: {escape(' | '.join(report.tightest_pair))}",
            f"a stop is {certified}; status {escape(str(report.status))}",
        ]
        plots: list[str] = []
        if not self._setup.replayed:
            rate, top = self._rates[-1], self._setup.config.nominal_rate_hz
            plots.append(_plot(f"loop, {rate:.0f} Hz", self._rates, 1.2 * top))
            plots.append(_plot(f"slowest tick, {self._times[-1]:.0f} us", self._times, 1e6 / top))
        if self._driving is not None:
            lines.insert(0, escape(self._driving.words))
        if frame.notice:
            lines.insert(0, _coloured(frame.notice, RED))
        cells = "".join(
            f"<tr><td style='color:#777;padding-right:0.6em;vertical-align:top'>{name}</td>"
            + "".join(f"<td style='width:45%;vertical-align:top'>{value}</td>" for value in values)
            + "</tr>"
            for name, values in rows
        )
        below = "<br>".join(lines) + "".join(plots)
        return f"<div style='{_STYLE}'><table style='width:100%'>{cells}</table>{below}</div>"

    def _why(self, frame: Frame, arm: str, binding: list[ActiveLimit]) -> str:
        return frame.why.get(arm) or why(frame.tick, arm, self._names[arm], binding, self._last.get(arm))

    def _tool_speed(self, tick: Tick, arm: str) -> str:
        """The mean speed of an arm's measured tool since the table was drawn before, beside the cell's limit."""
        (t, tools), limit = self._drawn_last, self._setup.config.control.tool_speed_limit
        if arm not in tools or tick.t <= t:
            return ""
        speed = float(np.linalg.norm(tick.tools[arm].translation - tools[arm].translation)) / (tick.t - t)
        return f"{speed:.2f}" if limit is None else f"{speed:.2f} of {limit:g}"

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


def _milliseconds(age: float | None) -> str:
    return "-" if age is None else f"{1e3 * age:.0f} ms"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows)
    return f"<div style='{_STYLE}'><table>{cells}</table></div>"


def _image(name: str, picture: bytes) -> str:
    data = f"data:image/jpeg;base64,{b64encode(picture).decode()}"
    return f"<div style='{_STYLE}'>{escape(name)}<img src='{data}' style='display:block;width:100%'></div>"


def _share(opening: float | None) -> str:
    return "-" if opening is None else f"{100.0 * opening:.0f} % open"


def _plot(label: str, values: Sequence[float], top: float) -> str:
    """A line of the last values, from 0 up to ``top``."""
    points = " ".join(
        f"{100.0 * i / _HISTORY:.0f},{20.0 * (1.0 - min(y / top, 1.0)):.1f}" for i, y in enumerate(values)
    )
    return (
        f"<div style='color:#777'>{label}</div><svg viewBox='0 0 100 21' preserveAspectRatio='none'"
        " style='display:block;width:100%;height:24px;background:#8881'><polyline fill='none' stroke='#3c78d8'"
        f" vector-effect='non-scaling-stroke' points='{points}'/></svg>"
    )
