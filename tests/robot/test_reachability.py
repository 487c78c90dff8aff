from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from q2r2_control.cli.check import PairsWritten, write_pairs
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")


def _with(config: Config, **changes: object) -> Config:
    return Config.model_validate(config.model_dump() | changes)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> PairsWritten:
    return write_pairs(CONFIG, tmp_path_factory.mktemp("pairs") / "cell.srdf", 2000, 0.05)


def test_a_pair_is_left_unmonitored_only_if_no_posture_brings_its_bodies_near_each_other(found: PairsWritten) -> None:
    assert found.never
    assert min(pair.nearest for pair in found.never) > 0.05
    robot, pruned = Robot.from_config(CONFIG), Robot.from_config(_with(CONFIG, srdf=found.file))
    never = {frozenset((pair.link_a, pair.link_b)) for pair in found.never}
    monitored = {frozenset((link_of(pair.name_a), link_of(pair.name_b))) for pair in pruned.distances(pruned.home)}
    assert not never & monitored
    assert {
        frozenset(("left_link_4", f"right_{other}")) for other in ("link_3", "link_7", "hand_e_envelope")
    } <= monitored
    random = np.random.default_rng(99)
    for _ in range(500):
        q = random.uniform(robot.position_lower, robot.position_upper)
        for pair in robot.distances(q):
            if frozenset((link_of(pair.name_a), link_of(pair.name_b))) in never:
                assert pair.distance > 0.05


@pytest.mark.parametrize("clearance", [0.0, 0.02, -1.0, 2.0, float("nan")])
def test_a_clearance_that_is_not_above_the_kept_distance_is_refused(tmp_path: Path, clearance: float) -> None:
    with pytest.raises(ConfigError, match=r"clearance = .* allowed: above control.min_distance, 0.02, up to 1"):
        write_pairs(CONFIG, tmp_path / "cell.srdf", 200, clearance)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('<robot><disable_collisions link1="table" link2="elbow"/></robot>', "no link 'elbow'"),
        ("<robot>", "not XML: no element found"),
        (b"\xff\xd8\xff\xe0", "not XML: not well-formed"),
    ],
)
def test_an_srdf_that_does_not_fit_its_cell_is_refused(tmp_path: Path, text: str | bytes, fault: str) -> None:
    file = tmp_path / "cell.srdf"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(ConfigError, match=fault):
        Robot.from_config(_with(CONFIG, srdf=str(file)))
