"""Convert recordings to log folders: ROS bags, receiver bytes, GPX (docs/log-folders.md)."""
