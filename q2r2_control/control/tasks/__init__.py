"""The tasks of the arms, as costs of the QP: kernels that add to H and g of  1/2 v' H v + g' v.

``frame`` follows a tool target, ``hold`` holds joints, ``posture`` uses those that no tool needs; which arm gives way
is a matter of the weights in ``priority``. Each of these modules has its model, data and kernels, and a line in each
part of ``built_in``. ``external`` loads costs by name: those of other packages, and of ``elbow`` and ``named_tasks``.
"""
