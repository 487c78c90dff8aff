"""Runs, or what ROS nodes publish, as MCAP files: a writer in a process of its own, readers, and replay."""
