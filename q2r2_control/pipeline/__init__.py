"""The one loop, once per tick: input -> teleop -> control -> plant. The only room that knows them all.

``pipeline`` builds the loop of a cell and takes what a program asks of it; ``pipeline_run`` is one run, whose ``tick``
reads like that line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.pipeline.pipeline import Pipeline
    from q2r2_control.pipeline.pipeline_run import PipelineRun

__all__ = ["Pipeline", "PipelineRun"]

__getattr__ = lazy_exports(__name__, {"Pipeline": "pipeline", "PipelineRun": "pipeline_run"})
