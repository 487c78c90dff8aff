"""The panel beside the scene: the arms' states with reasons, figures of the loop, and joints within their ranges."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from typing import Any

import numpy as np
import pinocchio as pin
import viser

from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActiveLimit
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
from q2r2_control.viewer.web.panel_html import (
    HISTORY,
    STYLE,
    coloured,
    distance,
    image,
    milliseconds,
    plot,
    share,
    table,
)
from q2r2_control.wording import sentence

_PERIOD = 0.2  # Time between two drawings of the table [s].
_NEAR_LIMIT = 0.05  # A joint counts as near a limit if its distance to the limit is less than this share of its range.
_EPISODES = 12  # Greatest number of lines about episodes that are shown.
_OF_EPISODES = (
    *(
        TeleopReason.EPISODE_BEGINS,
        TeleopReason.EPISODE_ENDS,
        TeleopReason.EPISODE_SUCCEEDED,
        TeleopReason.EPISODE_FAILED,
    ),
    *(TeleopReason.EPISODE_DISCARDED, TeleopReason.MARK, TeleopReason.SUBTASK_BEGINS, TeleopReason.VERDICT),
)
_BUTTONS = {
    PageRequest.STOP: ("Stop: rest, and end the run", "red"),
    PageRequest.RESET: ("Take a stop back", "gray"),
    PageRequest.ENGAGE: ("Engage both arms", "green"),
    PageRequest.PAUSE: ("Pause both arms", "orange"),
    PageRequest.HOME: ("Bring both arms home", "blue"),
    PageRequest.RECORD: ("Begin or end an episode", "gray"),
    PageRequest.MARK: ("Mark this moment", "gray"),
    PageRequest.SUBTASK: ("Begin the next subtask", "gray"),
}


class Panel:
    """Shows the run's newest data, and sends the requests of its buttons and sliders."""

    def __init__(
        self,
        server: viser.ViserServer,
        setup: PageSetup,
        driving: Driving | None,
        answer: Callable[[Any], None],
        take_over: Callable[[viser.GuiButtonHandle, Callable[[], None]], None],
    ) -> None:
        """Build the panel.

        Args:
            server: The server of viser.
            setup: The cell and the contents of the page.
            driving: The gizmos that move the tools; None if the page moves no arm.
            answer: Sends a request to the run.
            take_over: Binds an action to a button, so that each press counts even if viser is busy.
        """
        self._setup, self._driving, self._words = setup, driving, setup.words(setup.device)
        self._answer, self._take_over = answer, take_over
        self._binding: dict[ActiveLimit, None] = {}
        self._told: list[tuple[str, str]] = []  # Time and text of each line about episodes.
        self._ticks, self._slowest = 0, 0.0  # Since the last table: number of ticks, and longest computing time [s].
        # Values of the plots: rates of the loop [Hz], and computing times of the slowest ticks [us].
        self._rates, self._times = deque[float](maxlen=HISTORY), deque[float](maxlen=HISTORY)
        self._moved: dict[PageSetting, float] = {}  # New values of moved sliders, which are not sent yet.
        self._shown = time.monotonic()  # Time of the last table [s].
        self._newest: Frame | None = None
        self._buttons: list[viser.GuiInputHandle[Any]] = []  # Buttons and sliders that are hidden when the run is over.
        self._drawn_last: tuple[float, Mapping[str, pin.SE3]] = 0.0, {}  # Time [s] and tool poses of the last table.
        gui = server.gui
        gui.set_panel_label(setup.title)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(60, 120, 216))
        gui.main_panel.dock_right()
        self._time_line: viser.GuiSliderHandle[float] | None = None
        if setup.replayed:
            self._add_time_line(gui)
        else:
            self._add_buttons(gui)
        self._banner = gui.add_html("", visible=False, order=-1.0)
        # A small window shows only the top of the panel, so the buttons are there. Lines that come and go are below the
        # buttons, so that no button moves.
        if driving is not None:
            with gui.add_folder("Grippers"):
                driving.add_buttons(gui)
        self._advice = gui.add_html("", visible=False)
        self._table = gui.add_html("")
        self._episodes = gui.add_html("", visible=False)
        self._cameras = gui.add_html("", visible=False)
        self._pictures: Mapping[str, bytes] = {}  # The newest pictures by camera.
        self._pictured: Mapping[str, bytes] = self._pictures  # The pictures that are shown.
        if setup.changes and not setup.replayed:
            self._add_settings(gui)
        if not setup.replayed:
            with gui.add_folder("Controls of a hand", expand_by_default=False):
                gui.add_html(table(self._words.controls().items()))

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
            self._buttons.append(button)
            if request is PageRequest.STOP:
                self._take_over(button, partial(self._answer, request))
            else:
                button.on_click(ask)

    def _add_time_line(self, gui: viser.GuiApi) -> None:
        play = gui.add_button("Play, or stand still", color="blue")
        play.on_click(lambda _: self._answer(PagePlay()))
        self._time_line = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)

        def seek(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client_id is not None:  # If there is no client, the panel itself moved the slider.
                self._answer(PageSeek(float(event.target.value)))

        self._time_line.on_update(seek)
        end = gui.add_button("End the replay", color="red")
        self._take_over(end, partial(self._answer, PageRequest.STOP))
        self._buttons += [play, self._time_line, end]

    def _add_slider(
        self,
        gui: viser.GuiApi,
        label: str,
        setting: PageSetting,
        numbers: tuple[float, float, float, float],
        unit: float,
    ) -> None:
        """Add a slider. ``numbers`` are its minimum, maximum, step and first value.

        The value of the setting is the slider's value times ``unit``.
        """
        slider = gui.add_slider(label, *numbers)

        def move(_: object) -> None:
            self._moved[setting] = unit * min(max(float(slider.value), numbers[0]), numbers[1])

        slider.on_update(move)
        self._buttons.append(slider)

    def follow(self, frame: Frame) -> None:
        """Keep the contents of a frame, which may be shown later. This is called with every frame, shown or not."""
        # In a replay, each frame has all events that say why the arms are in their states, since the time line can go
        # back.
        if self._setup.replayed:
            self._words.told = {}
        self._words.follow(frame.events)
        for event in frame.events:
            line = f"{event.t:.1f} s", sentence(event.reason)
            # The line is shown once, although each arm has an event with it.
            if event.kind in _OF_EPISODES and line not in self._told[-2:]:
                self._told.append(line)
        self._binding |= dict.fromkeys(frame.binding)
        if frame.pictures:
            self._pictures = {**self._pictures, **frame.pictures}
        self._ticks += frame.ticks
        self._slowest = max(self._slowest, frame.slowest)

    def end(self) -> None:
        """Show that the run is over, and hide the buttons, because they would do nothing."""
        for button in self._buttons:
            button.visible = False
        what = "replay" if self._setup.replayed else "run"
        after = "" if self._newest is None else f" after {self._newest.tick.t:.1f} s"
        text = f"The {what} is over{after}. Below is its last moment. The next run at this address shows up here."
        self._banner.content = f"<div style='{STYLE};font-size:15px'><b>{escape(text)}</b></div>"
        self._banner.visible = True
        if self._newest is not None:
            self._table.content = self._drawn(self._newest, [], over=True)
            self._advice.visible = False

    def show(self, frame: Frame) -> None:
        """Draw the table, and send the values of sliders that were moved. Both are done only once per ``_PERIOD``."""
        self._newest = frame
        passed = time.monotonic() - self._shown
        if passed >= _PERIOD:
            self._shown += passed
            ticks, self._ticks = self._ticks, 0
            slowest, self._slowest = self._slowest, 0.0
            self._rates.append(ticks / passed)
            self._times.append(1e6 * slowest)
            binding, self._binding = list(self._binding), {}
            self._table.content = self._drawn(frame, binding)
            self._advise(frame)
            # In a replay, the frames do not have all events, so the lines about episodes are not shown.
            if self._told and not self._setup.replayed:
                self._episodes.content, self._episodes.visible = table(self._told[-_EPISODES:]), True
            if (pictures := self._pictures) is not self._pictured:
                self._pictured, self._cameras.visible = pictures, True
                cameras = [*self._setup.config.cameras]  # Pictures are in the order of the cell's cameras.
                names = sorted(pictures, key=lambda name: cameras.index(name) if name in cameras else len(cameras))
                self._cameras.content = "".join(image(name, pictures[name]) for name in names)
            if (line := self._time_line) is not None and frame.tick.t != line.value:
                line.max = max(frame.end, line.max)
                line.value = frame.tick.t
            moved, self._moved = self._moved, {}
            for setting, value in moved.items():
                self._answer(PageChange(setting, value))

    def _drawn(self, frame: Frame, binding: list[ActiveLimit], over: bool = False) -> str:
        """Return the table of a frame as HTML. If the run is ``over``, rows that need a running loop are left out."""
        tick, arms = frame.tick, list(frame.tick.tools)
        rows = [
            ("", [f"<b>{escape(arm)}</b>" for arm in arms]),
            ("state", [coloured(tick.states[arm], state_colour(tick.states[arm])) for arm in arms]),
            ("why", [escape(frame.why.get(arm) or self._words.why(tick, arm, binding)) for arm in arms]),
            ("next", [escape(self._next(tick, arm)) for arm in arms]),
            ("off its target", [distance(tick.tracking_error(arm)[0]) for arm in arms]),
            ("hand's age", [milliseconds(frame.ages.get(arm)) for arm in arms]),
            ("tool speed [m/s]", [self._tool_speed(tick, arm) for arm in arms]),
            ("tool [m]", ["{:.3f} {:.3f} {:.3f}".format(*tick.tools[arm].translation) for arm in arms]),
            ("gripper", [share(tick.grippers.get(arm)) for arm in arms]),
            ("joints", [self._bars(frame, arm) for arm in arms]),
        ]
        if tick.sessions:
            rows.insert(1, ("cabinet", [escape(tick.sessions[arm]) for arm in arms]))
        if over:
            rows = [row for row in rows if row[0] not in ("next", "hand's age", "tool speed [m/s]")]
        self._drawn_last = tick.t, tick.tools
        cells = "".join(
            f"<tr><td style='color:#777;padding-right:0.6em;vertical-align:top'>{name}</td>"
            + "".join(f"<td style='width:45%;vertical-align:top'>{value}</td>" for value in values)
            + "</tr>"
            for name, values in rows
        )
        return f"<div style='{STYLE}'><table style='width:100%'>{cells}</table>{self._below(frame, over)}</div>"

    def _advise(self, frame: Frame) -> None:
        """Show what is wrong and who drives. An unchanged text is not sent again."""
        silent = any(self._words.is_silent(frame.tick, arm) for arm in frame.tick.tools)
        slowness = "" if self._driving is None else self._driving.slowness(silent)
        driver = frame.driver if self._driving is None else self._driving.words
        lines = [coloured(text, RED) for text in (frame.notice, slowness) if text]
        lines += [escape(driver)] if driver else []
        content = f"<div style='{STYLE}'>{'<br>'.join(lines)}</div>" if lines else ""
        if content != self._advice.content:
            self._advice.content, self._advice.visible = content, bool(lines)

    def _next(self, tick: Tick, arm: str) -> str:
        """Return what the operator of an arm can do next."""
        moves = tick.states[arm] in (ArmState.ENGAGED, ArmState.PAUSING)
        dragged = "" if self._driving is None else self._driving.next_step(arm, moves)
        return dragged or self._words.next_press(tick, arm)

    def _below(self, frame: Frame, over: bool) -> str:
        """Return, as HTML, lines and plots about the whole robot and the loop."""
        tick, report = frame.tick, frame.tick.reference.report
        certified = coloured("certified", GREEN) if report.certified else coloured("not certified", RED)
        pair = escape(" | ".join(report.tightest_pair))
        lines = [f"{tick.t:.1f} s", f"tightest pair (the two bodies with the least room between them): {pair}"]
        plots: list[str] = []
        if not over:
            lines.append(f"a stop is {certified}; status {escape(str(report.status))}")
        if not over and not self._setup.replayed:
            rate, top = self._rates[-1], self._setup.config.nominal_rate_hz
            plots.append(plot(f"loop, {rate:.0f} Hz", self._rates, 1.2 * top))
            plots.append(plot(f"slowest tick, {self._times[-1]:.0f} us", self._times, max(1e6 / top, *self._times)))
        return "<br>".join(lines) + "".join(plots)

    def _tool_speed(self, tick: Tick, arm: str) -> str:
        """Return the mean speed of an arm's measured tool since the last table, and the cell's limit, as text [m/s]."""
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
