"""Step 5: transformation estimation (Sec. III-E)."""
