"""Step 2: macro and micro structure (Sec. III-B)."""
