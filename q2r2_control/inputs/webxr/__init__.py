"""Hands that a web page in a headset's browser sends: nothing is installed there.

``webxr`` is the input, the loop's side. ``server`` is the process that serves ``page`` and its socket, and
``page_messages`` reads what the page sends. ``certificate`` makes what HTTPS needs, ``usb`` leads a cable's port here.
"""
