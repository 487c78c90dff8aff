"""The process that runs a loop: signals, scheduling, and folders for its files."""
