"""Franka Research 3 arms as a plant of q2r2_control. Franka's own library pylibfranka connects to the robots."""
