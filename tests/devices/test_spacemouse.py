"""SpaceMice: HID reports become velocities and buttons, and the input drives arms like every other device."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from q2r2_devices import reading
from q2r2_devices.spacemouse import MouseSettings, Reports

from q2r2_control import Config, ConfigError, InputError, Pipeline, TeleopReason, Tick
from q2r2_control.config.resources import find_resource
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.inputs import make_input
from tests.cli.command import CELL, q2r2
from tests.devices.mice import FULL, Hid, Mouse, both, buttons, rotation, translation, until
from tests.support.modules import ROOT

SETTINGS = MouseSettings(speed=0.2, angular_speed=0.8, dead_zone=0.1)
TICK = 0.01  # Time between two reports of a deflected cap [s].
Cell = Callable[..., Config]


@pytest.mark.parametrize(
    ("reports", "velocity"),
    [
        pytest.param([translation(back=-FULL)], (0.2, 0, 0, 0, 0, 0), id="pushed away: forwards"),
        pytest.param([translation(right=-FULL)], (0, 0.2, 0, 0, 0, 0), id="pushed left: left"),
        pytest.param([translation(down=-FULL)], (0, 0, 0.2, 0, 0, 0), id="pulled up: up"),
        pytest.param([rotation(about_back=-FULL)], (0, 0, 0, 0.8, 0, 0), id="about the forward axis"),
        pytest.param([rotation(about_right=-FULL)], (0, 0, 0, 0, 0.8, 0), id="about the left axis"),
        pytest.param([rotation(about_down=-FULL)], (0, 0, 0, 0, 0, 0.8), id="about the upward axis"),
        pytest.param([translation(FULL), rotation(FULL)], (0, -0.2, 0, 0, -0.8, 0), id="two reports add up"),
        pytest.param([both(FULL, 0, 0, 0, 0, -FULL)], (0, -0.2, 0, 0, 0, 0.8), id="all axes in 12 bytes"),
        pytest.param([translation(FULL), translation()], (0, 0, 0, 0, 0, 0), id="let go"),
        pytest.param([translation(back=-34)], (0, 0, 0, 0, 0, 0), id="inside the dead zone"),
        pytest.param([translation(back=-35 - 63)], (0.04, 0, 0, 0, 0, 0), id="a fifth of the way beyond the dead zone"),
        pytest.param([translation(back=-500)], (0.2, 0, 0, 0, 0, 0), id="more than full deflection"),
        pytest.param([translation(FULL), bytes([0x17, 100])], (0, -0.2, 0, 0, 0, 0), id="the battery's report"),
        pytest.param([translation(FULL), b"", b"\x01\x00"], (0, -0.2, 0, 0, 0, 0), id="reports that are too short"),
    ],
)
def test_a_report_gives_the_velocity_of_the_hand(reports: list[bytes], velocity: tuple[float, ...]) -> None:
    state, newest = Reports(SETTINGS), None
    for report in reports:
        newest = state.take(report) or newest
    assert newest is not None
    np.testing.assert_allclose(newest.velocity, velocity, atol=1e-12)


def test_a_report_gives_both_buttons() -> None:
    state = Reports(SETTINGS)
    for left, right in ((True, False), (True, True), (False, True), (False, False)):
        found = state.take(buttons(left, right))
        assert found is not None
        assert (found.inputs.button_lower, found.inputs.button_upper) == (left, right)


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Return a function that replaces hidapi's devices by mice. A lost mouse is searched for every millisecond."""
    monkeypatch.setattr(reading, "_RETRY", 0.001)

    def plug(*given: Mouse) -> None:
        monkeypatch.setitem(sys.modules, "hidraw" if sys.platform == "linux" else "hid", Hid(*given))

    yield plug
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("input_settings")]


class Run:
    """A run in simulated time with a SpaceMouse for each hand that has one in ``config``."""

    def __init__(self, config: Config) -> None:
        self.lines: list[str] = []
        self.input = make_input("spacemouse", config, say=self.lines.append)
        self.pipeline = Pipeline.from_config(config, input=self.input)
        self.ticks: list[Tick] = []
        self.pipeline.listeners.append(self.ticks.append)
        self.pipeline.begin()
        self.now = self.pipeline.tick().now

    def wait(self, duration: float, send: Callable[[], None] = lambda: None) -> None:
        """Let ``duration`` [s] pass in steps of :data:`TICK`. Call ``send``, which sends reports, before each step."""
        for _ in range(round(duration / TICK)):
            send()
            self.now += TICK
            self.pipeline.tick_until(self.now)

    def tool(self) -> Any:
        return self.ticks[-1].tools["right"].translation.copy()

    @property
    def state(self) -> str:
        return self.ticks[-1].states["right"]

    @property
    def kinds(self) -> list[Any]:
        return [event.reason.kind for tick in self.ticks for event in tick.events]


def tap(run: Run, mouse: Mouse) -> None:
    """Press and release the left button of the mouse."""
    for held in (True, False):
        mouse.send(buttons(left=held))
        run.wait(0.15)


def test_a_button_engages_the_arm_and_the_cap_moves_the_tool_until_the_cap_is_released(
    cell: Cell, plugged: Callable[..., None]
) -> None:
    mouse = Mouse("/dev/hidraw3")
    plugged(mouse, Mouse("/dev/hidraw0", usage=(1, 2)))  # The second device is an ordinary mouse.
    run = Run(cell("spacemouse", right={"speed": 0.1}))
    assert run.lines == ["input_settings.spacemouse.right: SpaceMouse Compact at /dev/hidraw3 is connected"]
    forwards = partial(mouse.send, translation(back=-FULL))
    before = run.tool()
    mouse.send(buttons())
    run.wait(0.5, forwards)
    mouse.send(translation())
    assert run.state == "idle"
    np.testing.assert_array_equal(run.tool(), before)
    tap(run, mouse)
    assert run.state == "engaged"
    run.wait(1.0)
    np.testing.assert_allclose(run.tool(), before, atol=1e-4)
    run.wait(1.0, forwards)
    mouse.send(translation())
    run.wait(1.0)
    np.testing.assert_allclose(run.tool() - before, (0.1, 0.0, 0.0), atol=0.003)
    run.pipeline.end()


def test_an_unplugged_mouse_stops_the_arms_and_drives_again_after_a_new_press(
    cell: Cell, plugged: Callable[..., None]
) -> None:
    mouse = Mouse("/dev/hidraw3", serial="A7")
    plugged(mouse)
    run = Run(cell("spacemouse", right={"device": "A7"}))
    mouse.send(buttons())
    run.wait(0.1)
    tap(run, mouse)
    run.wait(0.5, partial(mouse.send, translation(down=-FULL)))
    assert run.state == "engaged"
    mouse.send(translation())
    mouse.plugged = False
    until(lambda: not run.input.connected)
    run.wait(1.0)
    assert run.state == "lost"
    assert not [sample for tick in run.ticks[-100:] for sample in tick.samples]
    assert run.kinds[-1] is TeleopReason.CONNECTION_LOST
    lost = "input_settings.spacemouse.right: lost, read error; it is opened again as soon as it is there"
    assert run.lines[1:] == [lost]
    before = run.tool()
    mouse.plugged = True
    until(lambda: run.input.connected)
    mouse.send(buttons())
    run.wait(0.5, partial(mouse.send, translation(down=-FULL)))
    assert run.state == "lost"
    np.testing.assert_allclose(run.tool(), before, atol=1e-4)
    tap(run, mouse)
    assert run.state == "engaged"
    run.pipeline.end()


def test_a_deflected_mouse_that_falls_silent_stops_its_arm(cell: Cell, plugged: Callable[..., None]) -> None:
    mouse = Mouse("/dev/hidraw3")
    plugged(mouse)
    run = Run(cell("spacemouse", right={}))
    mouse.send(buttons())
    run.wait(0.1)
    tap(run, mouse)
    run.wait(0.5, partial(mouse.send, translation(down=-FULL)))
    assert run.state == "engaged"
    run.wait(0.5)
    assert run.state == "lost"
    assert run.input.connected
    run.pipeline.end()


def test_each_hand_has_its_own_mouse(cell: Cell, plugged: Callable[..., None]) -> None:
    left, right = Mouse("/dev/hidraw3", serial="A7"), Mouse("/dev/hidraw4", serial="B9")
    plugged(left, right)
    given = make_input("spacemouse", cell("spacemouse", left={"device": "B9"}, right={"device": "/dev/hidraw3"}))
    given.start()
    left.send(buttons())
    assert [sample.hand for sample in given.poll(1.0)] == ["right"]
    right.send(buttons())
    assert [sample.hand for sample in given.poll(2.0)] == ["left", "right"]
    given.close()


@pytest.mark.parametrize(
    ("paths", "settings", "told"),
    [
        pytest.param((), {"right": {}}, "right: device = null: no SpaceMouse is there; connected now: none", id="none"),
        pytest.param(
            ("/dev/hidraw3", "/dev/hidraw4"),
            {"right": {}},
            "right: device = null: several devices fit; connected now: /dev/hidraw3 or S, /dev/hidraw4 or S",
            id="two",
        ),
        pytest.param(
            ("/dev/hidraw3",),
            {"left": {"device": "/dev/hidraw3"}, "right": {"device": "B9"}},
            "right: device = B9: is not there; connected now: /dev/hidraw3 or S",
            id="another one",
        ),
        pytest.param(
            ("/dev/hidraw3",),
            {"left": {}, "right": {}},
            "right: device = null: /dev/hidraw3 moves the other hand; allowed: the path or serial number of another "
            "SpaceMouse; connected now: /dev/hidraw3 or S",
            id="one for two hands",
        ),
        pytest.param(
            ("/dev/hidraw3",),
            {"left": {"device": "/dev/hidraw3"}, "right": {"device": "S"}},
            "right: device = S: /dev/hidraw3 moves the other hand; allowed: the path or serial number of another "
            "SpaceMouse; connected now: /dev/hidraw3 or S",
            id="the path and the serial number of the same mouse",
        ),
    ],
)
def test_if_the_mouse_of_a_hand_is_missing_the_start_fails_with_one_line_and_all_other_mice_are_closed(
    cell: Cell, plugged: Callable[..., None], paths: tuple[str, ...], settings: dict[str, Any], told: str
) -> None:
    plugged(*(Mouse(path, serial="S") for path in paths))
    given = make_input("spacemouse", cell("spacemouse", **settings))
    with pytest.raises(InputError) as raised:
        given.start()
    assert str(raised.value) == f"input_settings.spacemouse.{told}"
    assert not given.connected


def test_if_a_device_lacks_permission_the_start_fails_and_the_error_contains_the_udev_rule_that_helps(
    cell: Cell, plugged: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (node := tmp_path / "hidraw3").touch()
    plugged(Mouse(str(node)))
    # If root runs the test, no file lacks permission. The refusal is therefore simulated.
    monkeypatch.setattr(os, "access", lambda path, mode: path != str(node))
    given = make_input("spacemouse", cell("spacemouse", right={}))
    rule = r'as root, write KERNEL=="hidraw\*", ATTRS{idVendor}=="256f", TAG'
    with pytest.raises(InputError, match=rf"no permission to read .*hidraw3; {rule}"):
        given.start()


def test_a_cell_without_a_hand_or_with_a_wrong_setting_is_refused(cell: Cell) -> None:
    with pytest.raises(ConfigError, match=r"^input_settings.spacemouse: no hand; allowed: a hand, as right: \{\}$"):
        make_input("spacemouse", cell("spacemouse"))
    with pytest.raises(ConfigError, match=r"^input_settings.spacemouse: right.speed = 2: allowed: 1 or less$"):
        make_input("spacemouse", cell("spacemouse", right={"speed": 2}))


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("spacemouse", {"right": {"speed": 2}}, "input_settings.spacemouse: right.speed = 2: allowed: 1 or less"),
        ("lerobot", {"right": {}}, "input_settings.lerobot: right.teleoperator: missing"),
    ],
)
def test_the_command_check_names_a_wrong_setting_of_an_input_that_is_not_the_cells(
    cell: Cell, tmp_path: Path, name: str, settings: dict[str, Any], told: str
) -> None:
    data = read_yaml(find_resource(CELL).read_text(encoding="utf-8"))
    file = tmp_path / "cell.yaml"
    file.write_text(yaml_of(data | {"input_settings": {name: settings}}))
    cell(name)  # This call installs the entry points, so that the command finds them.
    done = q2r2("check", str(file))
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert told in done.stderr


def test_the_command_check_notes_settings_of_an_input_that_is_not_installed(tmp_path: Path) -> None:
    data = read_yaml(find_resource(CELL).read_text(encoding="utf-8"))
    file = tmp_path / "cell.yaml"
    file.write_text(yaml_of(data | {"input_settings": {"space_mouse": {"right": {}}}}))
    done = q2r2("check", str(file))
    assert done.exit_code == 0, done.stderr
    assert "input_settings.space_mouse: no installed input has this name; installed: " in " ".join(done.stdout.split())


def test_the_command_run_finds_the_input_by_its_name_and_prints_one_line_about_a_missing_mouse(
    cell: Cell, plugged: Callable[..., None], tmp_path: Path
) -> None:
    plugged()
    data = read_yaml(find_resource(CELL).read_text(encoding="utf-8"))
    file = tmp_path / "cell.yaml"
    file.write_text(yaml_of(data | {"input_settings": {"spacemouse": {"left": {}}}}))
    cell("spacemouse")  # This call installs the entry point, so that the command finds it.
    done = q2r2("run", str(file), "--input", "spacemouse", "--plant", "kinematic")
    assert done.exit_code == 2
    told = "input_settings.spacemouse.left: device = null: no SpaceMouse is there; connected now: none"
    assert done.stderr.count(told) == 1


def test_if_hidapi_is_not_installed_one_line_says_how_to_install_it(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "hidraw" if sys.platform == "linux" else "hid", None)
    with pytest.raises(
        InputError, match=r"^input_settings.spacemouse.right: hidapi is not installed; allowed: pip install 'hidapi"
    ):
        make_input("spacemouse", cell("spacemouse", right={})).start()


def test_the_real_hidapi_reads_reports_from_a_terminal_that_replaces_the_device(tmp_path: Path) -> None:
    """The real library opens, reads and loses a pseudo-terminal, to which a small library gives a HID descriptor."""
    pytest.importorskip("hidraw", reason="pip install hidapi")
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler")
    folder = Path(__file__).parent
    library = tmp_path / "descriptor.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, folder / "descriptor.c", "-ldl"], check=True)
    paths = os.pathsep.join([str(ROOT), str(ROOT / "plugins/q2r2_devices"), *sys.path])
    environment = os.environ | {"LD_PRELOAD": str(library), "PYTHONPATH": paths}
    program = [sys.executable, "-m", "tests.devices.real_hidapi"]
    result = subprocess.run(program, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == ["engages", "forwards", "lost", "engages"]
