"""Faults of a headset's data, which no arm may follow. The data come through the TCP door, in MuJoCo, in simulated
time.

At every tick of every run the controller's contract holds, and no arm has a target that nobody engaged. An arm that was
let go stays at rest, and a target begins at its tool and never jumps: :mod:`tests.support.headset_in_step`.
"""
