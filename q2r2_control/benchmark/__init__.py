"""Comparison of the controller with public ones: times of a tick, and two-armed work motions."""
