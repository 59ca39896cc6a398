"""A machine: its body and sensors, what these read, the samples it sends, and logs of it."""
