"""Robots and cells: find models, join them into one URDF, check it, and build Pinocchio's model and monitored pairs."""
