"""A run is recorded and replayed from the command line, as a user does it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.command import FAST, changed_cell, one_object, q2r2

pytestmark = pytest.mark.slow

OPTIONS = (*FAST[2:], "--duration", "1.5")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recorded run, in which both arms are engaged and move."""
    parent = tmp_path_factory.mktemp("recordings")
    cell = changed_cell(parent, "", "")
    given = ("--record", str(parent / "here"), "--task", "a circle", "--operator", "Ada")
    result = q2r2("run", cell, *OPTIONS, *given)
    assert result.exit_code == 0
    recording = one_object(result.stdout)["recording"]
    assert recording["ticks"] == one_object(result.stdout)["ticks"]
    assert (recording["lost_ticks"], recording["fault"]) == (0, None)
    return Path(recording["file"]).parent


def test_a_replay_without_a_difference_prints_identical_and_exits_with_0(recorded: Path) -> None:
    for file in (recorded, *recorded.glob("*.mcap")):
        result = q2r2("replay", str(file), "--compare")
        assert (result.exit_code, result.stdout, result.stderr) == (0, "identical\n", "")


def test_with_a_cell_that_differs_from_the_recorded_cell_replay_prints_the_differences_and_exits_with_1(
    recorded: Path, tmp_path: Path
) -> None:
    other = changed_cell(tmp_path, "position_scale: 1.0 ", "position_scale: 1.5 ")
    result = q2r2("replay", str(recorded), "--compare", "--config", other)
    assert result.exit_code == 1
    assert result.stdout.startswith("first difference at ")
    assert ".target." in result.stdout
    assert "teleop.position_scale: 1.0 when recorded, now 1.5" in result.stderr


def test_on_a_plant_that_was_not_the_plant_of_the_run_replay_prints_the_distances_of_the_tools(recorded: Path) -> None:
    data = one_object(q2r2("replay", str(recorded), "--plant", "mujoco", "--json").stdout)
    assert data["ticks"] == data["summary"]["ticks"] > 1000
    assert data["ended_by"] is None
    assert "difference" not in data
    assert all(0.0 < arm["position_mm_max"] < 5.0 for arm in data["arms"].values())
    data = one_object(q2r2("replay", str(recorded), "--plant", "kinematic", "--compare", "--json").stdout)
    assert data["difference"] is None
    assert all(arm["position_mm_max"] + arm["rotation_deg_max"] < 1e-3 for arm in data["arms"].values())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--viewer",),
            "--viewer: without --plant there is no window; allowed: a plant that has one, as --plant mujoco",
        ),
        (("--plant", "kinematic", "--viewer"), "--viewer: the kinematic plant has no window"),
        (("--plant", "mujoco", "--compare"), "recorded with KinematicPlant; allowed with --compare: --plant kinematic"),
        (("--plant", "fri"), "--plant fri: it keeps real time; allowed in a replay: mujoco, kinematic"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_for_options_that_exclude_each_other_replay_prints_one_line_and_exits_with_code_2(
    recorded: Path, options: tuple[str, ...], said: str
) -> None:
    result = q2r2("replay", str(recorded), *options)
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert said in result.stderr
