"""Places of joints, bodies and tools, and distances of bodies: kernels over a robot's joint tree and its shapes.

``kinematics`` places joint frames; ``collision`` holds the bodies and monitored pairs and places them;
``closest_points`` knows segments and boxes; ``pair_distance`` measures pairs and gives their gradients.
"""
