"""How long a steady stream of messages may stop before its source counts as lost: one default for all of them."""

# Eleven periods of a 75 Hz headset, so that a few lost or late messages on a wireless link do not stop the arms; short
# enough that a tool at the default 0.5 m/s moves no more than 75 mm before it begins to brake. It holds for hand data,
# tool poses, targets and acknowledgements of commands.
STREAM_TIMEOUT = 0.15  # [s]
