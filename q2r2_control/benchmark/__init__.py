"""Comparison of our controller with public controllers: computing times of a tick, and errors in work motions."""
