"""The tasks of ``q2r2 demo``, and the judges that decide whether the simulated arms did them."""
