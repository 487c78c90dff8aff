"""Tasks of ``q2r2 demo``, and the judges that say whether the simulated arms did them."""
