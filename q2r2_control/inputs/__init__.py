"""Where hand samples come from. To add an input, implement ``Input`` of ``base``.

``scripted`` plays ``trajectories``, of which those that pick things up stand in ``assembly``, as ``way_points``:
``played`` makes samples of hands whose poses are functions of time, ``sampling`` says when, and what the measurement
adds. ``headset`` is the TCP server for the Quest2ROS app: ``framing``, ``messages`` and ``session`` are its protocol
without sockets, ``admission`` says who may drive, ``listener`` takes connections in, ``connections`` serves them,
``rate_limits`` bounds what strangers can make it do, ``hands_watch`` finds poses that must not be followed (with
``moved_frame``), ``samples`` is the queue between its thread and the loop, ``statistics``, ``addresses`` and
``headset_check`` are what people see of it.
"""
