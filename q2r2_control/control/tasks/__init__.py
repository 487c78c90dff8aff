"""The tasks of the arms, as costs of the QP: kernels that add to H and g of  1/2 v' H v + g' v.

``frame`` follows a tool target; ``task_data`` holds joints and uses those that no tool needs; ``external`` has costs
of other packages. Which arm gives way is a matter of their weights. Each kernel
takes a ``TaskModel`` (fixed) and ``TaskData`` (rewritten at each tick).
"""
