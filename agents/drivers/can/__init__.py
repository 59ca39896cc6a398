"""A machine's own bus: CAN frames by J1939, NMEA 2000 or a DBC become the values of sensors."""
