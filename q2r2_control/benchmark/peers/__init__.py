"""Public controllers to compare with, each in a module of its own, which alone imports its package.

``base`` has the interface of a controller in the bench, the settings that all peers get, and which peers there are;
``mink``, ``pink`` and ``roboplan`` are built by ``make_peer`` where their packages are installed.
"""

from q2r2_control.benchmark.peers.base import PEERS, BenchController, Setup, build_peers, is_installed, make_peer

__all__ = [
    "PEERS",
    "BenchController",
    "Setup",
    "build_peers",
    "is_installed",
    "make_peer",
]
