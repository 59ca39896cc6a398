"""A machine: body, sensors, readings, samples, logs."""
