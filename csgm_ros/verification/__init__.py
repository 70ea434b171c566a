"""Whether the transform of step 5 is right: evidence and verdict."""
