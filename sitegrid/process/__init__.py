"""What a long-running command needs: signals, children, logs, progress."""
