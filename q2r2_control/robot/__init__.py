"""Robots and cells: found, joined to one URDF, checked, and made a Pinocchio model with the pairs that are watched."""
