"""Recordings as datasets that policies are trained on. None of it needs ROS.

``sampling`` takes frames at a fixed rate out of a recording, ``features`` makes named vectors of them, ``pictures``
finds the pictures that belong to them, ``episodes`` does so for many recordings, in several processes or on a
``ray_cluster``, and once only, and ``kept_pictures`` keeps the pictures meanwhile. ``lerobot``, ``hdf5`` and
``csv_tables`` write what comes out, with ``statistics`` and ``video`` for the first and ``pixel_files`` for the second;
``thread_policies`` keeps the encoder from going before a control loop. ``bags`` writes episodes as they were recorded.
``output`` sees to it that nothing half is left.
"""
