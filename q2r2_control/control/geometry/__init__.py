"""Kernels that compute the poses of joints and bodies, and the distances of bodies.

``kinematics`` computes the poses of joint frames. ``collision`` holds the bodies and monitored pairs, and computes the
poses of the bodies. ``closest_points`` computes the closest points of segments and boxes. ``pair_distance`` computes
the distances of pairs and their gradients.
"""
