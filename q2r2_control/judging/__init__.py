"""Whether a recorded episode is fit to be learned from, and why not. None of it needs ROS.

``episode`` reads a recording into arrays; ``hands``, ``delay``, ``motion``, ``smoothness`` and ``timing`` make numbers
of them, which ``figures`` gathers; ``verdict`` holds those to the thresholds of a cell. ``judge`` does all of it for
files. ``plots`` and ``page`` show it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.judging.episode import Episode, read_episode
    from q2r2_control.judging.figures import EpisodeFigures, figures_of
    from q2r2_control.judging.judge import Judged, judge_all, keep_verdicts
    from q2r2_control.judging.parts import parts_of
    from q2r2_control.judging.verdict import Reason, Verdict, verdict_of

__all__ = [
    "Episode",
    "EpisodeFigures",
    "Judged",
    "Reason",
    "Verdict",
    "figures_of",
    "judge_all",
    "keep_verdicts",
    "parts_of",
    "read_episode",
    "verdict_of",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "Episode": "episode",
        "EpisodeFigures": "figures",
        "Judged": "judge",
        "Reason": "verdict",
        "Verdict": "verdict",
        "figures_of": "figures",
        "judge_all": "judge",
        "keep_verdicts": "judge",
        "parts_of": "parts",
        "read_episode": "episode",
        "verdict_of": "verdict",
    },
)
