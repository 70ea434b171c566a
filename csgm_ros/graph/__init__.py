"""Step 3: graph construction and the affinities K_p and K_q (Sec. III-C)."""
