"""The CAN buses of simulated machines: what their drive trains state, as frames of J1939."""
