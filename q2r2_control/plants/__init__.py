"""Robots that move, simulated or real.

A new plant implements ``Plant`` of ``base``, which also has the checks of commands. MuJoCo is imported only when it is
used.
"""
