"""Recordings of others become log folders: bags of ROS, bytes of receivers, GPX (docs/log-folders.md)."""
