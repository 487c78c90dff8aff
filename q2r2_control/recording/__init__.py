"""Runs kept in MCAP files that ROS 2 tools open, and replayed to the bit. None of it needs ROS.

``recorder`` listens to a run: ``packing`` makes bytes of a tick, and ``ring`` takes them to the process that
``writer_process`` starts. There ``writer`` does the rest: ``encoder`` makes messages of packed ticks, ``topics`` and
``rows`` say where each number stands in them, ``mcap_file`` is the file, ``bag`` what rosbag2 wants beside it,
``about`` what is said once. ``camera_process`` starts another one, which takes pictures as ``camera_work`` says, and
hands them to the first one through a ``picture_channel``; ``helper_process`` and ``helper`` are what both have in
common. ``base_recorder`` is what ``recorder`` and ``message_recorder`` share, which takes messages of ROS nodes
(``ros_topics``), serialized already. ``reader`` reads it again, ``ros_recording`` reads those of nodes by means of
``ros_ticks``, ``replay`` gives it to the pipeline's own loop, and ``comparison`` holds what comes out to what was
recorded, ``plant_difference`` where a plant moved to. ``joint_replay`` gives that loop the references alone, as
``recorded_way`` leads them.
"""
