"""Many pairs on many machines, and one frame for their clouds."""
