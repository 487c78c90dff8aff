"""Recordings as datasets that policies are trained on. None of it needs ROS.

``sampling`` takes frames at a fixed rate out of a recording, ``features`` makes named vectors of them, ``episodes``
does so for many recordings, in several processes and once only; ``lerobot`` and ``csv_tables`` write what comes out,
with ``statistics`` and ``tasks`` for the first, and ``output`` sees to it that nothing half is left.
"""
