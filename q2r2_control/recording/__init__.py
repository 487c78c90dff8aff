"""Recordings of runs, or of messages of ROS nodes, as MCAP files: a writer in its own process, readers, and replay."""
