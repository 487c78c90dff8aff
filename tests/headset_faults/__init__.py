"""What a headset's data must not do to an arm: through the TCP door, in MuJoCo, in simulated time.

At every tick of every run the controller's contract holds, no arm has a target that nobody engaged, an arm that was let
go stays at rest, and a target begins at its tool and never jumps: :mod:`tests.support.headset_in_step`.
"""
