"""The edge to people: command line, files, pictures, a synthetic Kinect and SfM."""
