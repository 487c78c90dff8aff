"""Whether a recorded episode is fit to be learned from, and why not."""
