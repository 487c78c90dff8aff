"""The one loop, once per tick: input -> teleop -> control -> plant. The only room that knows them all.

``pipeline`` builds the loop of a cell and takes what a program asks of it; ``pipeline_run`` is one run, whose ``tick``
reads like that line.
"""
