"""During a run, each episode gets its verdict as soon as it has ended, by the same rules as after the run."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.events import Event, Reason
from q2r2_control.export.episodes import FrameSampling, keep_episodes, make_episode
from q2r2_control.judging.episode_judge import EpisodeJudge, Question, written_episode
from q2r2_control.judging.judge import Judged, judge
from q2r2_control.judging.page import page_of
from q2r2_control.recording.about import About
from q2r2_control.recording.reader import EpisodeSpan, Recording
from q2r2_control.recording.recorder import Recorder
from q2r2_control.recording.replay import replay
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.haptics import EPISODE_KEPT, EPISODE_REJECTED
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HapticFeedback
from tests.export.files import load_vectors, write_vectors
from tests.judging.episodes import EPISODES, RATE, Work, hands, killed, loop_of, operator, record_episode
from tests.support.processes import alive, wait_until

pytestmark = pytest.mark.slow

# There is one episode with work, one that its operator discards, and one in which nothing moves.
TOGGLED, GIVEN_UP = (1.0, 2.5, 3.0, 4.0, 6.0), 3.7
VERDICTS_BY = {2.8: 1, 3.9: 1, 6.3: 2}  # At each of these times [s], the run waits for this number of verdicts.
DURATION = 7.0
FIRST = EpisodeSpan(1.0, 2.5, number=1)
BEGINS, ENDS, DISCARDED = TeleopReason.EPISODE_BEGINS, TeleopReason.EPISODE_ENDS, TeleopReason.EPISODE_DISCARDED
RESTS = 3.6  # From this time on, the hands rest [s].


class PatientRun:
    def __init__(self, folder: Path, before: Callable[[EpisodeJudge], None] = lambda judge: None) -> None:
        self.told: list[Reason] = []
        self.felt: list[HapticFeedback] = []
        work = Work(5)
        source = hands(pose=lambda hand, t: work(hand, min(t, RESTS)), inputs=operator(TOGGLED, GIVEN_UP))
        source.send_haptic = self.felt.append  # type: ignore[method-assign, assignment]
        loop = self.loop = loop_of(source, teleop=EPISODES)
        with (
            Recorder(folder, "test", waits=True) as recorder,
            EpisodeJudge(lambda: recorder.file, self._report) as judge_now,
        ):
            self.judge, self._due = judge_now, dict(VERDICTS_BY)
            self.pid = judge_now.pid
            recorder.begin(About.of(loop, False, {}), loop.robot)
            before(judge_now)
            loop.listeners += [recorder, judge_now, self._patient]
            loop.run(DURATION, realtime=False)
        assert recorder.file is not None
        self.file = recorder.file

    def _report(self, reason: Reason) -> None:
        self.told.append(reason)
        self.loop.record_outcome(reason)

    def _patient(self, tick: Tick) -> None:
        for due in [due for due in self._due if tick.t >= due]:
            wait_until(partial(self._judged, self._due.pop(due)))

    def _judged(self, count: int) -> bool:
        self.judge.report_verdicts()
        return len(self.told) >= count or self.judge.pid is None


def names_of(judged: list[Judged]) -> list[list[str]]:
    """Return, for each episode, the names of the reasons to discard it."""
    return [[reason.name for reason in one.verdict.reasons] for one in judged]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> PatientRun:
    return PatientRun(tmp_path_factory.mktemp("verdicts"))


def test_each_verdict_equals_the_verdict_after_the_run(run: PatientRun) -> None:
    after = judge(Recording(run.file))
    assert names_of(after) == [[], ["operator"], ["max_idle_share"]]
    assert run.told == [
        Reason.of(TeleopReason.VERDICT, episode=number, keep=keep, line=after[number - 1].verdict.line)
        for number, keep in ((1, True), (3, False))
    ]  # Episode 2 gets no verdict, since the operator has discarded it.


def test_both_hands_feel_each_verdict_and_a_replay_of_the_run_finds_no_difference(run: PatientRun) -> None:
    for pulse in (EPISODE_KEPT, EPISODE_REJECTED):
        felt = {one.hand for one in run.felt if (one.frequency, one.amplitude) == (pulse.frequency, pulse.amplitude)}
        assert felt == {"left", "right"}
    assert replay(run.file).difference is None
    assert run.pid is not None
    assert not alive(run.pid), "its process ends with the run"


def test_no_episode_is_judged_before_it_is_completely_written(run: PatientRun, tmp_path: Path) -> None:
    written = killed(run.file, tmp_path / "part.mcap", round(2.45 * RATE))
    assert written_episode(Question(str(written), FIRST, timed=True)) is None
    whole = written_episode(Question(str(run.file), FIRST, timed=True))
    assert whole is not None
    assert len(whole.ticks.t) == pytest.approx(1.5 * RATE, abs=2)


def test_an_episode_that_is_discarded_before_its_verdict_gets_no_verdict(run: PatientRun) -> None:
    told: list[Reason] = []
    with EpisodeJudge(lambda: run.file, told.append) as judge_now:
        for t, kind in zip((1.0, 2.5, 2.6, 4.0, 6.0), (BEGINS, ENDS, DISCARDED, BEGINS, ENDS), strict=True):
            judge_now.record_event(Event(t, "left", "", "", Reason(kind)))

        def answered() -> bool:
            judge_now.report_verdicts()
            return bool(told)

        wait_until(answered)
    (verdict,) = told
    assert (verdict.detail["episode"], verdict.detail["keep"]) == (2, False)


def test_a_killed_judge_is_reported_once_and_the_run_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def kill(judge_now: EpisodeJudge) -> None:
        assert judge_now.pid is not None
        os.kill(judge_now.pid, signal.SIGKILL)

    with caplog.at_level(logging.WARNING):
        run = PatientRun(tmp_path, kill)
    assert run.told == []
    (line,) = [entry.getMessage() for entry in caplog.records if "judge" in entry.getMessage()]
    ended = "the process that judges episodes was ended by SIGKILL"
    assert line == f"episodes are not judged before the run ends: {ended}"
    assert [one.verdict.keep for one in judge(Recording(run.file))] == [True, False, False]


# There are three episodes: from 1 to 2.5 s, from 3 to 4.5 s, and from 5 s on. The operator rates the first episode as a
# success, and discards the second one.
PARTS, SUCCEEDED, DISCARDED_AT, MARKED = (1.0, 2.5, 3.0, 4.5, 5.0), 2.7, 4.7, 1.7
PARTS_DURATION = 7.0
CONTROLS = operator(PARTS, DISCARDED_AT, MARKED, SUCCEEDED)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_episode(tmp_path_factory.mktemp("parts"), hands(5, inputs=CONTROLS), PARTS_DURATION, teleop=EPISODES)


@pytest.fixture(scope="module")
def judged(file: Path) -> list[Judged]:
    return judge(Recording(file))


def test_each_episode_is_judged_only_by_its_own_content(judged: list[Judged]) -> None:
    assert [one.figures.part for one in judged] == [1, 2, 3]
    assert names_of(judged) == [[], ["operator"], []]
    assert [one.figures.success for one in judged] == [True, None, None]
    durations = [one.figures.duration_s for one in judged]
    assert durations == [pytest.approx(seconds, abs=0.05) for seconds in (1.5, 1.5, 2.0)]
    assert [one.figures.timing.lost_ticks for one in judged] == [0, 0, 0]
    assert [one.figures.hands["left"].pose_rate_hz for one in judged] == pytest.approx(3 * [75.0], rel=0.05)
    assert all(one.figures.idle_share is not None and one.figures.idle_share < 0.5 for one in judged)
    # The gripper closes at 2 s, which is in the first episode.
    assert [one.figures.arms["left"].gripper_changes for one in judged] == [1, 0, 0]


def test_times_of_events_count_from_the_start_of_their_episode_and_the_page_names_each_episode(
    file: Path, judged: list[Judged]
) -> None:
    marks = [(event.t, event.kind) for event in judged[0].episode.events]
    assert marks == [
        (pytest.approx(0.0, abs=0.02), "episode_begins"),
        (pytest.approx(MARKED - PARTS[0], abs=0.03), "mark"),
        (pytest.approx(1.5, abs=0.03), "episode_ends"),
    ]
    page = page_of(judged, "Recordings")
    assert all(f" {file.stem} #{number}</a>" in page for number in (1, 2, 3))


def test_kept_episodes_become_episodes_of_a_dataset_with_their_own_frames(file: Path, tmp_path: Path) -> None:
    made = keep_episodes([file], FrameSampling(fps=50), write_vectors, tmp_path)
    assert made.left_out == made.unreadable == []
    episodes = [load_vectors(kept) for kept in made.kept]
    assert [kept.stem for kept in made.kept] == [f"{file.stem}-1", f"{file.stem}-3"]
    assert [episode.success for episode in episodes] == [True, None]
    succeeded = [np.flatnonzero(episode.outcome()["next.success"]).tolist() for episode in episodes]
    assert succeeded == [[episodes[0].frames - 1], []]
    assert episodes[0].frames == pytest.approx(75, abs=2)
    assert episodes[1].frames >= 100  # The episode lasts until the arms are at rest.
    whole = make_episode(file, FrameSampling(fps=250))
    for episode, began in zip(episodes, (1.0, 5.0), strict=True):
        state = episode.vectors["observation.state"]
        near = whole.vectors["observation.state"][round((began - 0.05) * 250) : round((began + 0.05) * 250)]
        assert np.abs(near - state[0]).max(axis=1).min() < 1e-9


def test_without_a_recording_a_press_that_would_begin_an_episode_is_reported_once() -> None:
    loop = loop_of(hands(3, inputs=CONTROLS), teleop=EPISODES)
    summary = loop.run(1.5, realtime=False)
    assert [event.kind for event in summary.events].count(TeleopReason.NO_RECORDING) == 1
