"""What a control loop needs besides its data: time, signals, garbage collection, and the figures of a run.

``loop_clock`` says when a tick is due, ``process`` stops on signals without interrupting a tick, ``scheduling`` asks
the system for punctuality, ``plant_clock`` tells how old a state is. ``operator_side`` has all that is the operator's,
``arm_conditions`` what hands feel of arms, and ``geometry_updates`` fingers and held objects. ``recorder`` gives each
``Tick`` to listeners and its figures to ``run_summary``, which gathers them with ``joint_extremes``, ``histogram`` and
``torque_summary``.
"""
