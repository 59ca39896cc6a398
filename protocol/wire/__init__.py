"""What goes over Zenoh: key expressions, messages, their bytes, and sessions."""
