"""An input from a web page in a headset's browser, which sends the hands' poses. Nothing is installed on the headset.

``webxr`` is the input, in the process of the control loop. ``server`` is the process that serves ``page`` and its
socket, and ``page_messages`` reads the messages of the page. ``certificate`` makes the certificate for HTTPS, and the
token of the page's URL. ``usb`` connects a headset by a cable: it forwards a port of the headset to this computer.
"""
