"""Decides whether a recorded episode is fit for learning, and gives the reasons if it is not."""
