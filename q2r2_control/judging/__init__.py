"""Whether a recorded episode is fit to be learned from, and why not. None of it needs ROS.

``episode`` reads a recording into arrays; ``hands``, ``delay``, ``motion``, ``smoothness`` and ``timing`` make numbers
of them, which ``figures`` gathers; ``verdict`` holds those to the thresholds of a cell. ``judge`` does all of it for
files. ``plots`` and ``page`` show it.
"""
