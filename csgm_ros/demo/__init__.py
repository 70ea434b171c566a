"""A synthetic scene, simulated sensors, and the demonstration run of the live node."""
