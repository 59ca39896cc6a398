"""One machine: drivers, localisation, ground estimation, sampling, spool, uplink."""
