"""Sources of hand samples. To add an input, implement ``Input`` of ``base``.

``scripted`` plays hand motions, and ``played`` makes samples of them. The motions that handle parts are in
``assembly``. ``headset`` is the TCP server for the Quest2ROS app. ``messages`` and ``session`` are its protocol without
sockets. ``listener`` accepts connections and decides which client drives, and ``connections`` serves the clients.
``webxr`` is a page in a headset's browser instead, and ``page_door`` decides who may open it. ``hand_stream`` turns the
messages of both into samples. ``moved_frame`` and ``samples`` find poses that must not be followed, and queue the
others. ``headset_check`` tells people which data arrive.
"""
