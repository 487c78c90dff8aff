"""Robots that move, simulated or real. To add a plant, implement ``Plant`` of ``base``, which also checks commands.

MuJoCo is imported only where it is used.
"""
