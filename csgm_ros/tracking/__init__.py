"""A moving depth sensor in a large map of unknown scale: localise, track, get lost, find itself again."""
