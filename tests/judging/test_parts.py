"""Episodes that an operator tells of while a run is recorded: judged one by one, replayed as a whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from q2r2_control.events import ReasonKind
from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.export.kept_episodes import keep_episodes
from q2r2_control.judging.episode import read_episode
from q2r2_control.judging.judge import Judged, judge
from q2r2_control.judging.page import page_of
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.replay import replay
from tests.export.vectors import load_vectors, write_vectors
from tests.judging.runs import EPISODES, hands, loop_of, operator, record_episode

pytestmark = pytest.mark.slow

# Three episodes, 1 to 2.5, 3 to 4.5 and from 5 s on, of which the first succeeded and the second is discarded.
TOGGLED, SUCCEEDED, DISCARDED, MARKED = (1.0, 2.5, 3.0, 4.5, 5.0), 2.7, 4.7, 1.7
DURATION = 7.0
CONTROLS = operator(TOGGLED, DISCARDED, MARKED, SUCCEEDED)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_episode(tmp_path_factory.mktemp("parts"), hands(5, inputs=CONTROLS), DURATION, teleop=EPISODES)


@pytest.fixture(scope="module")
def judged(file: Path) -> list[Judged]:
    return judge(Recording(file))


def test_each_is_judged_by_what_is_in_it_alone(judged: list[Judged]) -> None:
    assert [one.figures.part for one in judged] == [1, 2, 3]
    assert [one.verdict.line for one in judged] == ["keep", "discard: its operator discarded it", "keep"]
    assert [one.figures.success for one in judged] == [True, None, None]
    durations = [one.figures.duration_s for one in judged]
    assert durations == [pytest.approx(seconds, abs=0.05) for seconds in (1.5, 1.5, 2.0)]
    assert [one.figures.timing.lost_ticks for one in judged] == [0, 0, 0]
    for one in judged:
        hand = one.figures.hands["left"]
        assert hand.pose_rate_hz == pytest.approx(75.0, rel=0.05)
        assert one.figures.idle_share is not None
        assert one.figures.idle_share < 0.5
    # The gripper closes at 2 s, which is in the first one.
    assert [one.figures.arms["left"].gripper_changes for one in judged] == [1, 0, 0]


def test_its_events_are_by_its_own_time(judged: list[Judged]) -> None:
    marks = [(event.t, event.kind) for event in judged[0].episode.events]
    assert marks == [
        (pytest.approx(0.0, abs=0.02), "episode_begins"),
        (pytest.approx(MARKED - TOGGLED[0], abs=0.03), "mark"),
        (pytest.approx(1.5, abs=0.03), "episode_ends"),
    ]


def test_they_have_names_of_their_own_on_the_page(file: Path, judged: list[Judged]) -> None:
    page = page_of(judged, "Recordings")
    for number in (1, 2, 3):
        assert f" {file.stem} #{number}</a>" in page


def test_the_run_is_replayed_to_the_bit(file: Path) -> None:
    found = replay(file)
    assert found.difference is None
    assert found.ended_by is None


def test_frames_are_of_the_ticks_that_they_were_of(file: Path, judged: list[Judged]) -> None:
    whole = read_episode(Recording(file))
    for one, began in zip(judged, (1.0, 3.0, 5.0), strict=True):
        episode = one.episode
        np.testing.assert_allclose(np.diff(episode.frame_t), 0.012, atol=0.0045)
        at = np.searchsorted(whole.frame_t, began + episode.frame_t[10], side="left")
        near = whole.tools[max(at - 3, 0) : at + 3, 0, :3]
        assert np.abs(near - episode.tools[10, 0, :3]).max(axis=1).min() < 1e-9


def test_those_that_are_kept_become_episodes_of_a_dataset_with_frames_of_their_own(file: Path, tmp_path: Path) -> None:
    made = keep_episodes([file], FrameSampling(fps=50), write_vectors, tmp_path)
    assert made.skipped == []
    episodes = [load_vectors(kept) for kept in made.kept]
    assert [kept.stem for kept in made.kept] == [f"{file.stem}-1", f"{file.stem}-3"]
    assert [episode.success for episode in episodes] == [True, None]
    succeeded = [np.flatnonzero(episode.outcome()["next.success"]).tolist() for episode in episodes]
    assert succeeded == [[episodes[0].frames - 1], []]
    assert episodes[0].frames == pytest.approx(75, abs=2)
    assert episodes[1].frames >= 100  # and until the arms are at rest
    whole = make_episode(file, FrameSampling(fps=250))
    for episode, began in zip(episodes, (1.0, 5.0), strict=True):
        state = episode.vectors["observation.state"]
        near = whole.vectors["observation.state"][round((began - 0.05) * 250) : round((began + 0.05) * 250)]
        assert np.abs(near - state[0]).max(axis=1).min() < 1e-9
    again = keep_episodes([file], FrameSampling(fps=50), write_vectors, tmp_path)
    assert again.kept == made.kept


def test_where_nothing_is_recorded_the_controls_say_so() -> None:
    loop = loop_of(hands(3, inputs=CONTROLS), teleop=EPISODES)
    summary = loop.run(1.5, realtime=False)
    assert [event.kind for event in summary.events].count(ReasonKind.NO_RECORDING) == 1
