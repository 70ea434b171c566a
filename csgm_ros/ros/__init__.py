"""The edge to ROS 2: messages, parameters, one worker, the lifecycle node."""
