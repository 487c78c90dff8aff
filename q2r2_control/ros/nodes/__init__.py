"""The nodes: one module for each executable, and one module for the executables of both arms.

``launch.executables`` runs them.
"""
