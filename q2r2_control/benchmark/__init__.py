"""Comparison of the controller with public controllers: times of a tick, and work motions of two arms."""
