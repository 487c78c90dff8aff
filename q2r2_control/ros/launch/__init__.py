"""What happens before a node runs; nothing here needs rclpy.

``processes`` says which nodes a cell needs and runs them together (``q2r2 ros up``, ``launch/teleop.launch.py``);
``middleware`` sets up Fast DDS; ``build`` builds the message packages of ``ros/interfaces``. Nothing is imported here:
every node needs ``middleware``, and no node needs the others.
"""
