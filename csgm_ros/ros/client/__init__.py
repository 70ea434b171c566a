"""The other side of the node's topics and services: calls, playing, sending, receiving."""
