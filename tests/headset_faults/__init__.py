"""Faults of a headset's data, which no arm may follow.

A fake headset sends the data over TCP. The arms are simulated by MuJoCo, in simulated time. At every tick of every run,
:mod:`tests.support.headset_in_step` checks four things: the controller's contract holds, no arm has a target before it
is engaged, an arm that was paused stays at rest, and each target begins at its tool pose and never jumps.
"""
