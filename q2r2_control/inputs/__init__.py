"""Where hand samples come from. To add an input, implement ``Input`` of ``base``.

``scripted`` plays hand motions, those that pick things up from ``assembly``; ``played`` makes samples of them.
``headset`` is the TCP server for the Quest2ROS app. ``messages`` and ``session`` are its protocol without sockets.
``listener`` takes connections in and says who may drive, and ``connections`` serves them. ``webxr`` is a page in a
headset's browser instead, and ``page_door`` says who may open it. ``hand_stream`` is the way of the messages of either.
``moved_frame`` and ``samples`` find poses that must not be followed and queue the others. ``headset_check`` tells
people which data come.
"""
