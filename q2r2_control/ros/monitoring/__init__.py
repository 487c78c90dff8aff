"""What a node knows about other nodes, so that it can stop in time and name the one that is missing."""
