"""The tasks of the arms, as costs of the QP. Kernels add them to H and g of  1/2 v' H v + g' v.

``frame`` lets a tool follow its target, ``hold`` holds joints, and ``posture`` moves joints as far as the tools leave
them free. If one arm blocks the other, the weights in ``priority`` decide which arm gives way. Each of these modules
has its model, data and kernels, and a line in each part of ``built_in``. ``external`` loads tasks by name: tasks of
other packages, of ``elbow`` and of ``named_tasks``.
"""
