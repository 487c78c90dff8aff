"""Decide whether a recorded episode is fit for learning, and give the reasons if it is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports
from q2r2_control.extras import require

if TYPE_CHECKING:
    from q2r2_control.config.recording import JudgeSettings as JudgeSettings
    from q2r2_control.judging.figures import EpisodeFigures as EpisodeFigures
    from q2r2_control.judging.judge import Judged as Judged
    from q2r2_control.judging.judge import Unreadable as Unreadable
    from q2r2_control.judging.judge import Verdict as Verdict
    from q2r2_control.judging.judge import judge_all as judge_all

require("data", "work with recordings")

_MODULES = {
    "EpisodeFigures": "figures",
    "JudgeSettings": ".config.recording",
    "Judged": "judge",
    "Unreadable": "judge",
    "Verdict": "judge",
    "judge_all": "judge",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
