"""Worker drivers: programs that have a systemd unit, a container or a ROS 2 node do a worker's work."""
