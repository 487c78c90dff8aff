"""Franka Research 3 arms as a plant of q2r2_control, by Franka's own library pylibfranka."""
