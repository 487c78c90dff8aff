"""The record of one tick, and the figures of a whole run."""
