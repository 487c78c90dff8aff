"""What happens before a node runs; nothing here needs rclpy.

``processes`` says which nodes a cell needs and runs them together (``q2r2 ros up``, ``launch/teleop.launch.py``);
``executables`` starts one of them; ``middleware`` sets up Fast DDS; ``build`` builds the message packages of
``ros/interfaces``. They are imported when first used: every node needs ``middleware``, and no node needs the others.
"""
