"""Public controllers to compare with, each in a module of its own, which alone imports its package.

``base`` has the interface of a controller in the bench, the settings that all peers get, and which peers there are;
``mink``, ``pink`` and ``roboplan`` are built by ``make_peer`` where their packages are installed.
"""
