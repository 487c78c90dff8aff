"""Hands that a web page in a headset's browser sends. Nothing has to be installed on the headset.

``webxr`` is the input, on the loop's side. ``server`` is the process that serves ``page`` and its socket, and
``page_messages`` reads the messages of the page. ``certificate`` makes the certificate and the token that HTTPS needs.
``usb`` forwards a port of a headset on a cable to this computer.
"""
