"""The controller beside public ones: times of a tick, and two-armed work motions."""
